"""Random scenarios for imitation rollouts: an object at rest, and the arm that observes it.

Objects are at poses from training scenes (at the handover, on the way there, or on the table) with
random offsets. The arm is at its start pose or observes the object from a random pose. An invisible
sphere in place of a person's hand occludes some objects partly; grasps keep clear of the sphere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, PandaConfig
from handover_marl.datasets import Dataset
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.geometry.rotations import quaternions_from_euler
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Array = npt.NDArray[np.float64]

# Distance from the initial position from which an object counts as moving (m).
_MOVED = 0.02
# Shares of scenarios with the object at the handover pose of a recording, and on the way there; in the others it is on
# the table.
_HANDOVER_POSE_SHARE, _ON_THE_WAY_SHARE = 0.65, 0.15
# Standard deviations of the random displacement along each axis (m) and rotation about each axis (rad) of an object at
# the handover pose or on the way there.
_POSITION_STD, _ROTATION_STD = 0.04, 0.2
# Largest random displacement of an object on the table along x and y (m); its rotation about the vertical is random.
_TABLE_RANGE = 0.12
# Share of scenarios with the arm at its start pose, where half of them have noise with a standard deviation (rad) on
# every joint; in the others the arm observes the object from a random pose.
_START_POSE_SHARE, _JOINT_STD = 0.6, 0.04
# Smallest and largest distance of the robot's hand from the object at a random pose (m).
_MIN_DISTANCE, _MAX_DISTANCE = 0.2, 0.5
# Largest distance along each axis of the point at which the camera aims from the object's origin (m).
_AIM_ERROR = 0.05
# Share of scenarios in which a sphere occludes the object partly, and its smallest and largest radius (m).
_OCCLUDED_SHARE, _OCCLUDER_RADII = 0.5, (0.03, 0.07)


@dataclass(frozen=True, eq=False)
class ImitationScenario:
    """Initial state of an imitation rollout: object, arm and occluding sphere.

    Attributes:
        object_name: YCB class name of the object.
        dof: (6,) float32 position xyz (m) and intrinsic XYZ Euler angles (rad) of the object in the world.
        joints: (7,) positions of the arm joints (rad).
        occluder: (4,) center in the world and radius of the occluding sphere (m); radius 0 for none.
    """

    object_name: str
    dof: npt.NDArray[np.float32]
    joints: Array
    occluder: Array

    @property
    def object_pose(self) -> Array:
        """World pose (7,) of the object, quaternion xyzw."""
        return np.concatenate([self.dof[:3], quaternions_from_euler(self.dof[3:])])


class ImitationScenarios:
    """Sampler of random initial states (object, arm, occluding sphere) of imitation rollouts: `ImitationScenario`s.

    Args:
        data: Dataset of the scenes.
        scenes: Numbers of the training scenes.
        arm: Kinematics of the robot's arm.
        panda: Base and start pose of the robot.
        seed: Seed of all scenarios.
    """

    def __init__(self, data: Dataset, scenes: Sequence[int], arm: ArmInWorld, panda: PandaConfig, seed: int) -> None:
        self._data, self._scenes, self._arm, self._seed = data, scenes, arm, seed
        self._start = np.array(panda.start_joints[:ARM_DOF])
        self._base = np.array(panda.base_position)

    def sample(self, number: int) -> ImitationScenario:
        """Return a random scenario; it depends only on the seed of the sampler and on `number`."""
        rng = np.random.default_rng((self._seed, number))
        scene = self._data.load_scene(self._scenes[int(rng.integers(len(self._scenes)))])
        dof = self._sample_object_pose(scene.object_dof[:, 0], rng)
        joints = self._sample_joints(dof[:3].astype(np.float64), rng)
        radius = rng.uniform(*_OCCLUDER_RADII) if rng.random() < _OCCLUDED_SHARE else 0.0
        # Off center, so that a part of the object stays visible.
        direction = rng.standard_normal(3)
        center = dof[:3] + direction / np.linalg.norm(direction) * rng.uniform(0.5, 1.5) * radius
        return ImitationScenario(scene.info.target_name, dof, joints, np.array([*center, radius]))

    def _sample_object_pose(self, path: npt.NDArray[np.float32], rng: np.random.Generator) -> npt.NDArray[np.float32]:
        kind = rng.random()
        if kind >= _HANDOVER_POSE_SHARE + _ON_THE_WAY_SHARE:
            return self._sample_table_pose(path[0], rng)
        dof = path[-1]
        if kind >= _HANDOVER_POSE_SHARE:
            moving = np.flatnonzero(np.linalg.norm(path[:, :3] - path[0, :3], axis=1) > _MOVED)
            dof = path[int(rng.choice(moving))] if len(moving) else dof
        rotation = Rotation.from_rotvec(rng.normal(0.0, _ROTATION_STD, 3)) * Rotation.from_euler("XYZ", dof[3:])
        position = dof[:3] + rng.normal(0.0, _POSITION_STD, 3)
        return np.concatenate([position, rotation.as_euler("XYZ")]).astype(np.float32)

    def _sample_table_pose(self, dof: npt.NDArray[np.float32], rng: np.random.Generator) -> npt.NDArray[np.float32]:
        rotation = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) * Rotation.from_euler("XYZ", dof[3:])
        shift = np.array([*rng.uniform(-_TABLE_RANGE, _TABLE_RANGE, 2), 0.0])
        return np.concatenate([dof[:3] + shift, rotation.as_euler("XYZ")]).astype(np.float32)

    def _sample_joints(self, position: Array, rng: np.random.Generator) -> Array:
        if rng.random() >= _START_POSE_SHARE:
            low, high = self._arm.limits
            for _ in range(4):
                goal = self._sample_viewing_pose(position, rng)
                solutions, converged = self._arm.solve(goal[None], self._start[None], 60)
                if converged[0]:
                    clipped: Array = np.clip(solutions[0], low, high)
                    return clipped
        noise = rng.normal(0.0, _JOINT_STD, ARM_DOF) * (rng.random() < 0.5)
        joints: Array = self._start + noise
        return joints

    def _sample_viewing_pose(self, target: Array, rng: np.random.Generator) -> Array:
        """Return a random world pose (7,) of the Panda's hand link that looks at a position (3,), nearly upright."""
        direction = rng.standard_normal(3)
        # On the side of the robot's base, 11 degrees above the horizontal.
        to_base = self._base - target
        to_base[2] = 0.2 * np.linalg.norm(to_base[:2])
        if direction @ to_base < 0.0:
            direction -= 2.0 * (direction @ to_base) / (to_base @ to_base) * to_base
        distance = rng.uniform(_MIN_DISTANCE, _MAX_DISTANCE)
        position = target + direction / np.linalg.norm(direction) * distance
        z = target + rng.uniform(-_AIM_ERROR, _AIM_ERROR, 3) - position
        z /= np.linalg.norm(z)
        x = Rotation.from_quat(self._arm.compute_hand_pose(self._start)[3:]).as_matrix()[:, 0]
        x = x - (x @ z) * z
        x /= max(float(np.linalg.norm(x)), 1e-6)
        rotation = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
        rotation = rotation * Rotation.from_rotvec([0.0, 0.0, rng.normal(0.0, 0.3)])
        return np.concatenate([position, rotation.as_quat()])


def find_occluded_points(points: npt.NDArray[np.float32], hand: Array, occluder: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the points of a cloud that are inside a sphere or hidden behind it from the wrist camera.

    Args:
        points: (n, 3) points in the hand link's frame (m).
        hand: (7,) world pose of the hand link, quaternion xyzw.
        occluder: (4,) center in the world and radius of the sphere (m); radius 0 occludes nothing.
    """
    camera = np.array(WRIST_CAMERA.position)
    center = inverse_transform_points(hand, occluder[None, :3])[0] - camera
    rays = points - camera
    lengths = np.maximum((rays**2).sum(axis=1), 1e-12)
    # Nearest point to the sphere's center on each segment from camera to point.
    share = np.clip(rays @ center / lengths, 0.0, 1.0)
    occluded: npt.NDArray[np.bool_] = np.linalg.norm(share[:, None] * rays - center, axis=1) < occluder[3]
    return occluded
