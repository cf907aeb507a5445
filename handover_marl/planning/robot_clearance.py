"""Clearances of the Panda's gripper and arm (elbow to wrist), for many configurations at once.

Hand, fingers and flange are modeled as boxes, elbow to wrist as capsules, and other bodies as spheres. Hand link poses
`hands` and spheres are in the same frame. Lengths are in meters, poses are position and quaternion xyzw, and a negative
clearance is the penetration depth.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.model_files.meshes import find_farthest_points
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.geometry.vectors import compute_box_distances
from handover_marl.planning.arm_control import ArmInWorld

Array = npt.NDArray[np.float64]

#: Boxes of the open gripper in the frame of `panda_hand`: hand body, both fingers, and the flange
#: behind the hand. They bound HandoverSim's collision meshes, the flange's without its corners.
GRIPPER_BOX_CENTERS = np.array([[0.0, 0.0, 0.02], [0.0, 0.0533, 0.0855], [0.0, -0.0533, 0.0855], [0.0, 0.0, -0.065]])
GRIPPER_BOX_HALF_SIZES = np.array(
    [[0.0316, 0.104, 0.046], [0.0105, 0.0133, 0.0271], [0.0105, 0.0133, 0.0271], [0.055, 0.055, 0.04]]
)

#: Center and half size of the volume that the fingers sweep when they close, in the frame of `panda_hand`.
CLOSING_BOX = (np.array([0.0, 0.0, 0.0855]), np.array([0.0105, 0.0666, 0.0271]))
# Numbers of the boxes that sweep a volume on the straight approach: hand body and flange.
_APPROACH_BOXES = (0, 3)
_FLANGE = 3
# Center and half size of the volume between the pads of the open gripper, slightly smaller than the graspable volume.
_PAD_REGION = (np.array([0.0, 0.0, 0.094]), np.array([0.008, 0.04, 0.014]))

#: Capsules of elbow, forearm and wrist: number of the moving link, both ends of the axis in the link's frame, radius.
#: They cover the convex hulls of the collision meshes of links 4 to 6, of which the forearm is asymmetric, to 1.6 cm.
ARM_CAPSULES = (
    (3, (0.0, 0.0, 0.045), (-0.08, 0.07, 0.0), 0.06),
    (3, (-0.082, 0.0, 0.0), (-0.082, 0.082, 0.0), 0.055),
    (3, (-0.04, 0.08, 0.0), (-0.085, 0.082, 0.0), 0.053),
    (4, (0.0, 0.0, -0.215), (0.0, 0.0, -0.005), 0.055),
    (4, (0.0, 0.035, -0.195), (0.0, 0.08, -0.01), 0.053),
    (4, (0.0, 0.0, -0.215), (0.0, 0.04, -0.195), 0.053),
    (4, (0.0, 0.04, -0.04), (0.0, 0.075, 0.0), 0.053),
    (5, (0.0, 0.0, 0.0), (0.088, 0.0, 0.0), 0.055),
    (5, (0.02, 0.01, 0.0), (0.085, 0.032, 0.0), 0.053),
)

_LINKS = np.array([link for link, *_ in ARM_CAPSULES])
_STARTS, _ENDS = (np.array([capsule[end] for capsule in ARM_CAPSULES]) for end in (1, 2))
_RADII = np.array([capsule[3] for capsule in ARM_CAPSULES])

_MIN_LENGTH = 1e-9
# Grid of barycentric coordinates on which a triangle is sampled.
_GRID = np.linspace(0.0, 1.0, 6)


@dataclass(frozen=True, eq=False)
class Spheres:
    """Surface of a body approximated by spheres.

    Attributes:
        centers: (k, 3) centers of the spheres (m).
        radii: (k,) radii of the spheres (m).
    """

    centers: Array
    radii: Array

    def transform_to_frame(self, pose: Array) -> "Spheres":
        """Return the spheres in another frame, whose pose in the present frame is `pose` (7,), quaternion xyzw."""
        return Spheres(inverse_transform_points(pose, self.centers), self.radii)

    def select_within(self, position: Array, distance: float) -> "Spheres":
        """Return the spheres with centers within a distance (m) of a position (3,)."""
        is_near = np.linalg.norm(self.centers - position, axis=1) < distance
        return Spheres(self.centers[is_near], self.radii[is_near])

    @classmethod
    def join(cls, parts: Sequence["Spheres"]) -> "Spheres":
        """Return the spheres of several bodies, given in the same frame, as one body."""
        return cls(np.concatenate([part.centers for part in parts]), np.concatenate([part.radii for part in parts]))


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """Closest pair of points between the robot and a body approximated by spheres.

    Attributes:
        distance: Distance of the two surfaces (m), negative where they overlap.
        point: (3,) closest point on the robot, in the world (m).
        normal: (3,) unit vector in the world from the closest sphere to the robot.
    """

    distance: float
    point: Array
    normal: Array


def sample_surface_spheres(vertices: Array, faces: npt.NDArray[np.int_], count: int, radius: float) -> Spheres:
    """Place `count` spheres of a radius (m), fewer on tiny meshes, evenly on a mesh: vertices (v, 3), faces (f, 3)."""
    weights = np.array([(a, b, 1.0 - a - b) for a in _GRID for b in _GRID if a + b <= 1.0])
    points = np.einsum("sk,fkc->fsc", weights, vertices[faces]).reshape(-1, 3)
    chosen = find_farthest_points(points, min(count, len(points)), 0)
    return Spheres(points[chosen], np.full(len(chosen), radius))


def compute_gripper_corners(hands: Array) -> Array:
    """Return the corners (n, 32, 3) in m of the open gripper's four boxes at hand link poses (n, 7), in their frame."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    local = (GRIPPER_BOX_CENTERS[:, None] + signs * GRIPPER_BOX_HALF_SIZES[:, None]).reshape(-1, 3)
    rotations = Rotation.from_quat(hands[:, 3:]).as_matrix()
    return np.asarray(local @ rotations.transpose(0, 2, 1) + hands[:, None, :3])


def compute_flange_clearances(hands: Array, spheres: Spheres) -> Array:
    """Return clearances (n,) in m, negative on overlap, of a body from the flange alone at hand link poses (n, 7)."""
    local = _points_in_hands(hands, spheres.centers) - GRIPPER_BOX_CENTERS[_FLANGE]
    return np.asarray((compute_box_distances(local, GRIPPER_BOX_HALF_SIZES[_FLANGE]) - spheres.radii).min(axis=1))


def compute_open_gripper_clearances(hands: Array, spheres: Spheres) -> Array:
    """Return clearances (n,) in m, negative on overlap, of a body from open gripper and flange at hand poses (n, 7)."""
    local = _points_in_hands(hands, spheres.centers)
    boxes = zip(GRIPPER_BOX_CENTERS, GRIPPER_BOX_HALF_SIZES, strict=True)
    by_box = [(compute_box_distances(local - center, half) - spheres.radii).min(axis=1) for center, half in boxes]
    return np.asarray(np.min(by_box, axis=0))


def compute_grasp_clearances(hands: Array, spheres: Spheres, sweep: float = 0.0, flange: bool = True) -> Array:
    """Return clearances (n,) in m, negative on overlap, of a body from the closing gripper at hand link poses (n, 7).

    The gripper is the volume that the fingers sweep when they close, and the volume that the hand body and, with
    `flange`, the flange sweep on a straight approach of length `sweep` (m) along the hand link's z axis to the pose.
    """
    local = _points_in_hands(hands, spheres.centers)
    back = np.array([0.0, 0.0, 0.5 * sweep])
    distances = compute_box_distances(local - CLOSING_BOX[0], CLOSING_BOX[1])
    for box in _APPROACH_BOXES if flange else _APPROACH_BOXES[:1]:
        swept = compute_box_distances(local - GRIPPER_BOX_CENTERS[box] + back, GRIPPER_BOX_HALF_SIZES[box] + back)
        distances = np.minimum(distances, swept)
    return np.asarray((distances - spheres.radii).min(axis=1))


def count_points_between_pads(hands: Array, points: Array) -> npt.NDArray[np.int_]:
    """Return the numbers (n,) of the points (k, 3) that are between the open finger pads at hand link poses (n, 7)."""
    local = _points_in_hands(hands, points)
    return np.asarray((np.abs(local - _PAD_REGION[0]) < _PAD_REGION[1]).all(axis=-1).sum(axis=1))


def find_closest_points(hand: Array, spheres: Spheres) -> ClosestPoints:
    """Return the closest points of a body and the open gripper at a hand link's world pose (7,), quaternion xyzw."""
    rotation = Rotation.from_quat(hand[3:]).as_matrix()
    local = (spheres.centers - hand[:3]) @ rotation
    offsets = local[None] - GRIPPER_BOX_CENTERS[:, None]
    by_box = zip(offsets, GRIPPER_BOX_HALF_SIZES, strict=True)
    distances = np.stack([compute_box_distances(offset, half) for offset, half in by_box])
    box, sphere = np.unravel_index(int(np.argmin(distances - spheres.radii)), distances.shape)
    half = GRIPPER_BOX_HALF_SIZES[box]
    offset = offsets[box, sphere]
    on_box = np.clip(offset, -half, half) + GRIPPER_BOX_CENTERS[box]
    direction = on_box - local[sphere]
    length = float(np.linalg.norm(direction))
    if length > _MIN_LENGTH:
        direction = direction / length
    else:
        # The center of the sphere is inside the box: the normal points from it to the center of the box.
        direction = -offset / max(float(np.linalg.norm(offset)), _MIN_LENGTH)
    distance = float(distances[box, sphere] - spheres.radii[sphere])
    return ClosestPoints(distance, hand[:3] + rotation @ on_box, rotation @ direction)


def compute_arm_clearances(arm: ArmInWorld, joints: Array, spheres: Spheres) -> Array:
    """Return clearances (n,) in m between the arm (elbow to wrist) at joints (n, 7) in rad and a body in the world."""
    starts, ends = _arm_segments(arm, joints)
    points = spheres.centers
    axes = ends - starts
    # Expanded scalar products avoid an array of (n, capsules, k, 3) difference vectors.
    along = axes @ points.T - (axes * starts).sum(axis=-1)[..., None]
    squared = (axes**2).sum(axis=-1)[..., None]
    share = along / np.maximum(squared, _MIN_LENGTH)
    np.clip(share, 0.0, 1.0, out=share)
    along *= 2.0
    along -= share * squared
    along *= share
    distances = (starts**2).sum(axis=-1)[..., None] - 2.0 * (starts @ points.T) + (points.T**2).sum(axis=0)
    distances -= along
    np.sqrt(np.maximum(distances, 0.0, out=distances), out=distances)
    distances -= spheres.radii
    distances -= _RADII[:, None]
    return np.asarray(distances.min(axis=(1, 2)))


def compute_lowest_heights(arm: ArmInWorld, joints: Array) -> Array:
    """Return the world z (n,) in m of the lowest point of arm (elbow to wrist) and open gripper at joints (n, 7)."""
    starts, ends = _arm_segments(arm, joints)
    capsules = (np.minimum(starts[..., 2], ends[..., 2]) - _RADII).min(axis=1)
    return np.asarray(np.minimum(capsules, compute_gripper_corners(arm.compute_hand_poses(joints))[..., 2].min(axis=1)))


def find_closest_arm_points(arm: ArmInWorld, joints: Array, spheres: Spheres) -> tuple[ClosestPoints, int]:
    """Return the closest points of arm (elbow to wrist) and body at joints (7,) in rad, and the arm link's number."""
    starts, ends = (end[0] for end in _arm_segments(arm, joints[None]))
    axes = (ends - starts)[:, None]
    from_start = spheres.centers - starts[:, None]
    along = (from_start * axes).sum(axis=-1) / np.maximum((axes**2).sum(axis=-1), _MIN_LENGTH)
    feet = starts[:, None] + np.clip(along, 0.0, 1.0)[..., None] * axes
    offsets = feet - spheres.centers
    lengths = np.linalg.norm(offsets, axis=-1)
    distances = lengths - spheres.radii - _RADII[:, None]
    capsule, sphere = np.unravel_index(int(np.argmin(distances)), distances.shape)
    normal = offsets[capsule, sphere] / max(float(lengths[capsule, sphere]), _MIN_LENGTH)
    point = feet[capsule, sphere] - _RADII[capsule] * normal
    return ClosestPoints(float(distances[capsule, sphere]), point, normal), int(_LINKS[capsule])


def _arm_segments(arm: ArmInWorld, joints: Array) -> tuple[Array, Array]:
    """Return world positions (n, c, 3) in m of both ends of the axes of the c `ARM_CAPSULES` at joints (n, 7)."""
    origins, rotations = arm.compute_link_frames(joints)
    link_origins, link_rotations = origins[:, _LINKS], rotations[:, _LINKS]
    starts, ends = ((link_rotations @ local[..., None])[..., 0] + link_origins for local in (_STARTS, _ENDS))
    return starts, ends


def _points_in_hands(hands: Array, points: Array) -> Array:
    """Transform points (k, 3) to the frame of each of n hand links with poses (n, 7): (n, k, 3)."""
    return np.asarray((points[None] - hands[:, None, :3]) @ Rotation.from_quat(hands[:, 3:]).as_matrix())
