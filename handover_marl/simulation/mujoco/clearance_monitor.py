"""Smallest distance between robot and human hand during a motion, also relative to required distances."""

from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.geometry.kinematic_tree import BoundingSphere, read_tree
from handover_marl.geometry.poses import IDENTITY, transform_points
from handover_marl.simulation.mujoco.batch_simulation import HandKinematics
from handover_marl.simulation.mujoco.models.collision_shapes import compute_bounding_spheres
from handover_marl.simulation.mujoco.models.scene_spec import SceneModelBuilder

Array = npt.NDArray[np.float64]

_MAX_DISTANCE = 3.0  # m


class ClearanceMonitor:
    """Calculator of the smallest distance between a moving Panda and a moving human hand.

    Distances between collision shapes are slow to measure, and are measured at few times only: spheres around the links
    rule out most times, and bounds on the motion of the links rule out times near a measured one. All distances
    are measured in a separate MuJoCo model, whatever the physics engine of the world is.

    Args:
        panda_urdf: Model of the robot.
        hand_urdf: Model of the human hand.
        config: Base pose of the robot.
    """

    def __init__(self, panda_urdf: Path, hand_urdf: Path, config: PandaConfig) -> None:
        self._world_from_panda = np.array([*config.base_position, *config.base_orientation])
        # Bounding spheres of the links with collision shapes, by link number; -1 is the base.
        self._robot_spheres, self._hand_spheres = (
            compute_bounding_spheres(urdf, read_tree(urdf)) for urdf in (panda_urdf, hand_urdf)
        )
        built = SceneModelBuilder(PhysicsConfig(panda=config))
        built.add_robot(panda_urdf)
        built.add_hand(hand_urdf)
        self._model = model = built.spec.compile()
        self._data = mujoco.MjData(model)
        self._hand = HandKinematics(hand_urdf, built.hand_links)
        is_hand = model.body_mocapid[model.geom_bodyid] >= 0
        self._pairs = np.array([(a, b) for a in np.flatnonzero(~is_hand) for b in np.flatnonzero(is_hand)])
        # Sum of the collision margins of both shapes of each pair (m).
        self._margins = model.geom_margin[self._pairs].sum(axis=1)

    def compute_min_margin(
        self,
        robot: Array,
        hand: Array,
        robot_frames: tuple[Array, Array],
        hand_frames: tuple[Array, Array],
        required: Array | None = None,
    ) -> float:
        """Compute the smallest margin (m) in a motion: distance of robot and human hand minus the required distance.

        The distance is 0 if robot and hand overlap, so a margin can be negative. The result is at most 3 m.

        Args:
            robot: Joint positions (n, 9) of the Panda at n times (rad, m).
            hand: Joint positions (n, 51) of the human hand at these times (m, rad).
            robot_frames: World frames of the Panda's links at these positions, from `compute_link_trajectory`.
            hand_frames: World frames of the human hand's links at these positions, from `compute_link_trajectory`.
            required: Required distances (n,) in m, at least 0; None for zeros.
        """
        needed = np.zeros(len(robot)) if required is None else required
        spheres = [
            _MovingSpheres(self._robot_spheres, robot_frames, self._world_from_panda),
            _MovingSpheres(self._hand_spheres, hand_frames, IDENTITY),
        ]
        bounds = _bound_distances(*spheres) - needed
        smallest, left = _MAX_DISTANCE, np.arange(len(bounds))
        while len(left):
            time = int(left[bounds[left].argmin()])
            # Larger distances at that time do not change the result.
            limit = smallest + float(needed[time])
            found = max(0.0, self.measure(robot[time], hand[time], limit))
            smallest = min(smallest, found - float(needed[time]))
            left = left[(bounds[left] < smallest) & (left != time)]
            moved = [own.bound_motion(time, left) for own in spheres]
            bounds[left] = np.maximum(bounds[left], found - moved[0] - moved[1] - needed[left])
            left = left[bounds[left] < smallest]
        return smallest

    def measure(self, robot: Array, hand: Array, max_distance: float) -> float:
        """Measure the distance of robot and human hand (m), at most `max_distance`; 0 or negative if they overlap.

        Args:
            robot: Joint positions (9,) of the Panda (rad, m).
            hand: Joint positions (51,) of the hand (m, rad).
            max_distance: Distance (m) beyond which no search is needed.
        """
        model, data = self._model, self._data
        poses = self._hand.compute_poses(hand[None])
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = robot, poses[0][0], poses[1][0]
        mujoco.mj_kinematics(model, data)
        first, second = self._pairs.T
        between = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
        bounds = between - model.geom_rbound[first] - model.geom_rbound[second] - self._margins
        nearest = max_distance
        for number in np.argsort(bounds):
            if bounds[number] >= nearest:
                break
            margin, pair = float(self._margins[number]), self._pairs[number].tolist()
            found = mujoco.mj_geomDistance(model, data, *pair, nearest + margin, None)
            nearest = min(nearest, found - margin)
        return nearest


class _MovingSpheres:
    """Bounding spheres of all links of a robot or a human hand at n times.

    Attributes:
        centers: Centers (n, b, 3) of the b spheres in the world frame (m).
        radii: Radii (b,) of the spheres (m).
    """

    def __init__(self, spheres: dict[int, BoundingSphere], frames: tuple[Array, Array], world_from_base: Array) -> None:
        links = [link for link in spheres if link >= 0]
        origins, rotations = (part[:, links] for part in frames)
        offsets = np.array([spheres[link].center for link in links])
        self.radii = np.array([spheres[link].radius for link in links])
        self.centers = origins + (rotations @ offsets[..., None])[..., 0]
        self._rotations = rotations.reshape(*rotations.shape[:2], 9)
        if -1 in spheres:
            # The base does not move, but the hand may come near it.
            count = len(self.centers)
            center = transform_points(world_from_base, spheres[-1].center)
            self.radii = np.append(self.radii, spheres[-1].radius)
            self.centers = np.concatenate([self.centers, np.broadcast_to(center, (count, 1, 3))], axis=1)
            self._rotations = np.concatenate([self._rotations, np.zeros((count, 1, 9))], axis=1)

    def bound_motion(self, time: int, others: npt.NDArray[np.int_]) -> Array:
        """Return upper bounds (k,) in m on the motion of link points from time index `time` to k indices `others`."""
        shifts = np.linalg.norm(self.centers[others] - self.centers[time], axis=-1)
        # A rotation by an angle moves a point at distance r by 2 r sin(angle / 2).
        swings = np.linalg.norm(self._rotations[others] - self._rotations[time], axis=-1) / np.sqrt(2.0)
        bound: Array = (shifts + self.radii * swings).max(axis=1, initial=0.0)
        return bound


def _bound_distances(first: _MovingSpheres, second: _MovingSpheres) -> Array:
    """Return the smallest distances (n,) in m, at least 0, between spheres of two moving sets at n times."""
    between = np.linalg.norm(first.centers[:, :, None] - second.centers[:, None], axis=-1)
    gaps: Array = (between - first.radii[:, None] - second.radii).min(axis=(1, 2))
    return np.maximum(gaps, 0.0)
