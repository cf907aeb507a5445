"""Geometry and motion of the person's hand, from observed keypoints.

Keypoints are in the order of the hand model MANO: the wrist, then three joints, from the knuckle outwards, of each
finger: index, middle, little, ring, thumb.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.planning.robot_clearance import Spheres

Array = npt.NDArray[np.float64]

_WRIST, _INDEX, _LITTLE = 0, 1, 7
_FINGERS = ((1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12), (13, 14, 15))
# Palm edges between neighboring knuckles, and between the index finger's and the thumb's.
_PALM_EDGES = ((1, 4), (4, 10), (10, 7), (1, 14))
# Length of a fingertip with its pad relative to the bone before it (Buryanov and Kotiuk, 2010: 0.7 to 0.9).
_TIP_RATIO = 0.9
_PALM_RADIUS, _THUMB_RADIUS, _FINGER_RADIUS = 0.013, 0.012, 0.0095  # m
_SPHERES_PER_CAPSULE = 3
# The heel of the hand is wider than the capsules that meet in the wrist (m).
_HEEL_WIDTH, _HEEL_RADIUS = 0.02, 0.016
_VELOCITY_TIME_CONSTANT = 0.02  # s


@dataclass(frozen=True, eq=False)
class Capsules:
    """Surface of a body approximated by capsules.

    Attributes:
        starts: (k, 3) first end point of each capsule's axis (m).
        ends: (k, 3) second end point of each capsule's axis (m).
        radii: (k,) radii of the capsules (m).
    """

    starts: Array
    ends: Array
    radii: Array

    def compute_distances(self, points: Array) -> Array:
        """Return the signed distances (n,) in m, negative inside, from points (n, 3) to the nearest capsule."""
        nearest = np.full(len(points), np.inf)
        for start, end, radius in zip(self.starts, self.ends, self.radii, strict=True):
            axis = end - start
            squared = float(axis @ axis)
            along = np.clip((points - start) @ axis / squared, 0.0, 1.0) if squared > 0.0 else np.zeros(len(points))
            offsets = points - start - along[:, None] * axis
            nearest = np.minimum(nearest, np.sqrt(np.einsum("ij,ij->i", offsets, offsets)) - radius)
        return nearest


def hand_capsules_from_observation(observation: Observation) -> Capsules | None:
    """Return capsules in the world that approximate the person's hand, or None if there is no hand.

    Fingertips are not observed. The last bone of each finger gets the direction of the bone before it, rotated by the
    last joint, and 0.9 times the length of that bone.
    """
    if not observation["hand_present"][0]:
        return None
    points = observation["hand_keypoints"].astype(np.float64)
    rotations = _link_rotations(observation["hand_dof_position"].astype(np.float64))
    capsules = [(points[a], points[b], _PALM_RADIUS) for a, b in _PALM_EDGES]
    for number, (knuckle, middle, last) in enumerate(_FINGERS):
        radius = _THUMB_RADIUS if number == len(_FINGERS) - 1 else _FINGER_RADIUS
        before, bent = rotations[last - 2], rotations[last - 1]
        tip = points[last] + _TIP_RATIO * (bent * before.inv()).apply(points[last] - points[middle])
        capsules += [
            (points[_WRIST], points[knuckle], _PALM_RADIUS),
            (points[knuckle], points[middle], radius),
            (points[middle], points[last], radius),
            (points[last], tip, radius),
        ]
    starts, ends, radii = zip(*capsules, strict=True)
    return Capsules(np.array(starts), np.array(ends), np.array(radii))


def _link_rotations(dof: Array) -> list[Rotation]:
    """Return the world orientations of the links after the 15 finger joints, at the hand's joint positions (51,)."""
    base = Rotation.from_euler("XYZ", dof[3:6])
    rotations: list[Rotation] = []
    for joint, angles in enumerate(dof[6:].reshape(15, 3)):
        before = base if joint % 3 == 0 else rotations[-1]
        rotations.append(before * Rotation.from_euler("XYZ", angles))
    return rotations


class HandTracker:
    """Tracker of the position and velocity of a person's hand during one episode.

    Attributes:
        spheres: Spheres that approximate the hand in the world, or None if there is no hand.
        points: (k, 3) keypoints of the hand in the world (m), empty if there is no hand.
        velocity: (3,) filtered velocity of the keypoints' mean in the world (m/s).
    """

    def __init__(self) -> None:
        self.spheres: Spheres | None = None
        self.points, self.velocity = np.zeros((0, 3)), np.zeros(3)
        self._time = 0.0

    def update(self, time: float, observation: Observation) -> None:
        """Update position and velocity of the hand from the receiver's observation at a time (s)."""
        capsules = hand_capsules_from_observation(observation)
        if capsules is None:
            self.spheres, self.velocity, self.points = None, np.zeros(3), np.zeros((0, 3))
            return
        points = observation["hand_keypoints"].astype(np.float64)
        if len(self.points) and time > self._time:
            step = time - self._time
            kept = float(np.exp(-step / _VELOCITY_TIME_CONSTANT))
            measured = (points - self.points).mean(axis=0) / step
            self.velocity = kept * self.velocity + (1.0 - kept) * measured
        self._time, self.points = time, points
        shares = np.linspace(0.0, 1.0, _SPHERES_PER_CAPSULE)[:, None, None]
        fingers = (capsules.starts + shares * (capsules.ends - capsules.starts)).reshape(-1, 3)
        across = points[_INDEX] - points[_LITTLE]
        across = _HEEL_WIDTH * across / max(float(np.linalg.norm(across)), 1e-6)
        heel = points[_WRIST] + np.array([-1.0, 0.0, 1.0])[:, None] * across
        radii = np.append(np.tile(capsules.radii, _SPHERES_PER_CAPSULE), np.full(3, _HEEL_RADIUS))
        self.spheres = Spheres(np.concatenate([fingers, heel]), radii)

    def predict_attached_pose(self, points: Array, pose: Array, ahead: float) -> Array:
        """Return the world pose (7,; xyzw), `ahead` seconds from now, of a frame that is fixed to the person's hand.

        `pose` (7,) is the frame's pose at an earlier time, and `points` (k, 3) are the `reference_points` of that time.
        The frame moves with the hand until now, then without rotation at `velocity`; without a hand it stays at `pose`.
        """
        if points.shape != self.points.shape or not len(points):
            return pose
        before, after = points.mean(axis=0), self.points.mean(axis=0)
        rotation, _ = Rotation.align_vectors(self.points - after, points - before)
        position = after + rotation.apply(pose[:3] - before) + ahead * self.velocity
        return np.concatenate([position, (rotation * Rotation.from_quat(pose[3:])).as_quat()])

    @property
    def reference_points(self) -> Array:
        """Present keypoints (k, 3) of the hand in the world (m), for a later call of `predict_attached_pose`."""
        return self.points

    @property
    def speed(self) -> float:
        """Filtered speed of the person's hand (m/s)."""
        return float(np.linalg.norm(self.velocity))

    def compute_distance(self, position: Array) -> float:
        """Return the distance (m) of a world position (3,) to the hand's nearest keypoint, infinite without a hand."""
        return float(np.linalg.norm(self.points - position, axis=1).min()) if len(self.points) else np.inf
