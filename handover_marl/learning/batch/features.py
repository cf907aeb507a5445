"""Features of many observations at once; see `handover_marl.learning.features` for their meaning.

Values equal those of single observations to 1e-6 after the rounding to float32, and do not depend on
the batch.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP
from handover_marl.episode.observations import Observation, giver_observation_space, observation_space
from handover_marl.geometry.poses import compute_lengths, multiply_quaternions, rotate_points
from handover_marl.geometry.ycb import LARGEST_YCB_CLASS
from handover_marl.learning.encodings.custom_features import AgentFeatures
from handover_marl.learning.features import GRASP_SCALE, N_STACKED, SCALE, GraspProximityFeatures, count_features
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.grasp_selection import GraspSelectionBatch

Array = npt.NDArray[np.float64]
Vectors = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


class FeatureBatch(ABC):
    """Function from observations of r episodes to feature vectors."""

    def reset(self, row: int) -> None:  # noqa: B027
        """Clear the values that are stored from the previous episode.

        Args:
            row: Index of the episode.
        """

    @abstractmethod
    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the feature vectors (r, m).

        Args:
            rows: Indices (r,) of the episodes.
            observation: Arrays (r, ...) of their observations.
        """


def compute_handover_frames(observation: Observation) -> tuple[Array, Array]:
    """Return the handover frames of r episodes; see `features.handover_frame`.

    Returns:
        Origins (r, 3) in the world (m), and axes as columns (r, 3, 3).
    """
    origins = observation["replay_object_poses"][:, -1, :3].astype(np.float64)
    to_gripper = observation["gripper_pose"][:, :2] - origins[:, :2]
    length = compute_lengths(to_gripper)
    is_long = length > 1e-6
    x, y = np.where(is_long, to_gripper.T / np.where(is_long, length, 1.0), [[1.0], [0.0]])
    axes = np.zeros((len(origins), 3, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 0], axes[:, 1, 1], axes[:, 2, 2] = x, -y, y, x, 1.0
    return origins, axes


def rotate_to_frame(axes: Array, vectors: Array) -> Array:
    """Transform vectors (r, ..., 3) from the world to frames whose axes are the columns of (r, 3, 3)."""
    matrix = axes.reshape(len(axes), *[1] * (vectors.ndim - 2), 3, 3)
    parts = [vectors[..., axis, None] * matrix[..., axis, :] for axis in range(3)]
    rotated: Array = parts[0] + parts[1] + parts[2]
    return rotated


def rotate_to_world(axes: Array, vectors: Array) -> Array:
    """Transform vectors (r, 3) to the world from frames whose axes are the columns of (r, 3, 3)."""
    return rotate_to_frame(axes.swapaxes(1, 2), vectors)


class GiverFeatureBatch(FeatureBatch):
    """Batch of `features.giver_features`.

    Args:
        context: Task, with the position of the goal.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._goal = np.array(context.protocol.goal_center)

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the features (r, 39)."""
        origins, axes = compute_handover_frames(observation)
        wrists = observation["replay_wrist_poses"][:, -1, :3].astype(np.float64)
        later = _normalize(observation["replay_object_poses"][:, -1, 3:])
        # The fingers keep their position relative to the object until then.
        now = observation["object_poses"][:, 0].astype(np.float64)
        fingers = observation["hand_keypoints"][:, 1:].astype(np.float64).mean(axis=1) - now[:, :3]
        fingers = rotate_points(_normalize(now[:, 3:]) * _CONJUGATE, fingers)
        gripper = observation["gripper_pose"][:, :3] - origins
        orientation = Rotation.from_quat(later).as_matrix()
        parts = [
            SCALE * np.stack([compute_lengths(gripper[:, :2]), gripper[:, 2]], axis=1) - 5.0,
            SCALE * (origins - self._goal),
            SCALE * rotate_to_frame(axes, wrists - origins),
            SCALE * rotate_to_frame(axes, rotate_points(later, fingers)),
            _relative_columns(axes, orientation),
            observation["released"],
            _one_hot_classes(observation),
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)


class ReceiverFeatureBatch(FeatureBatch):
    """Batch of `features.receiver_features`.

    Args:
        context: Task, with the position of the goal and the longest duration.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._goal = np.array(context.protocol.goal_center)
        self._duration = context.protocol.horizon_steps * TIME_STEP

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the features (r, 56)."""
        gripper, items = (observation[key].astype(np.float64) for key in ("gripper_pose", "object_poses"))
        axes = Rotation.from_quat(gripper[:, 3:]).as_matrix()
        keypoints = observation["hand_keypoints"].astype(np.float64)
        hand = np.stack([keypoints[:, 0], keypoints[:, 1:].mean(axis=1)], axis=1)
        hand = np.where(observation["hand_present"][..., None] != 0.0, hand, gripper[:, None, :3])
        goal = np.broadcast_to(self._goal, (len(rows), 1, 3))
        positions = np.concatenate([items[:, :1, :3], hand, goal], axis=1) - gripper[:, None, :3]
        joints, velocities = observation["robot_joint_position"], observation["robot_joint_velocity"]
        parts = [
            rotate_to_frame(axes, 0.5 * SCALE * positions).reshape(len(rows), -1),
            _relative_columns(axes, Rotation.from_quat(items[:, 0, 3:]).as_matrix()),
            axes[:, 2],
            50.0 * joints[:, 7:] - 1.0,
            10.0 * velocities[:, 7:],
            joints[:, :7],
            observation["released"],
            observation["time"] / self._duration,
            observation["hand_present"],
            _one_hot_classes(observation),
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)


class GraspFeatureBatch(FeatureBatch):
    """Batch of `features.GraspFeatures`.

    Args:
        context: Robot, task and known grasps of the objects.
        selection: Selector of grasps.
    """

    def __init__(self, context: PolicyContext, selection: GraspSelectionBatch) -> None:
        self._selection, self._receiver = selection, ReceiverFeatureBatch(context)

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the features (r, 64), those of the grasp last."""
        return np.concatenate([self._receiver(rows, observation), self.grasp(rows, observation)], axis=1)

    def grasp(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the features (r, 8) of the best reachable grasps; zeros if no grasp is reachable."""
        grasps, clearances, exists = self._selection.select(rows, observation)
        grasps = np.where(exists[:, None], grasps, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        gripper = observation["gripper_pose"].astype(np.float64)
        gripper_from_world = _normalize(gripper[:, 3:]) * _CONJUGATE
        rotation = Rotation.from_quat(multiply_quaternions(gripper_from_world, _normalize(grasps[:, 3:]))).as_rotvec()
        translation = GRASP_SCALE * rotate_points(gripper_from_world, grasps[:, :3] - gripper[:, :3])
        ones = np.ones(len(rows))
        parts = np.concatenate([translation, rotation, np.stack([10.0 * clearances, ones], axis=1)], axis=1)
        return np.where(exists[:, None], parts, 0.0).astype(np.float32)


class GraspProximityFeatureBatch(FeatureBatch):
    """Batch of `features.GraspProximityFeatures`.

    Args:
        context: Robot, task and known grasps of the objects.
        selection: Selector of grasps.
    """

    def __init__(self, context: PolicyContext, selection: GraspSelectionBatch) -> None:
        self._grasp = GraspFeatureBatch(context, selection)

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the features (r, 12) of grasps and grippers."""
        grasp = self._grasp.grasp(rows, observation)
        translation, rotation, exists = grasp[:, :3], grasp[:, 3:6], grasp[:, 7:]
        distance, angle = (compute_lengths(vectors)[:, None].astype(np.float64) for vectors in (translation, rotation))
        scales = GraspProximityFeatures
        near = np.exp(-distance / GRASP_SCALE / scales.position_scale)
        aligned = np.exp(-angle / scales.angle_scale)
        fingers = 50.0 * observation["robot_joint_position"][:, 7:] - 1.0
        proximity = np.concatenate([near * exists, aligned * exists], axis=1)
        parts = [translation, rotation, proximity, fingers, observation["released"], exists]
        return np.concatenate(parts, axis=1).astype(np.float32)


class StackedFeatureBatch(FeatureBatch):
    """Batch of `features.StackedFeatures`.

    Args:
        features: Batch of the features of one observation.
        size: Number of these features.
        count: Number of episodes.
    """

    def __init__(self, features: FeatureBatch, size: int, count: int) -> None:
        self._features = features
        self._stacks = np.zeros((count, N_STACKED, size), dtype=np.float32)
        self._times = np.full(count, -1.0)

    def reset(self, row: int) -> None:
        """Forget the decisions of the previous episode."""
        self._features.reset(row)
        self._stacks[row], self._times[row] = 0.0, -1.0

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the stacked features (r, N_STACKED * size), those of the present decision first."""
        times = observation["time"][:, 0].astype(np.float64)
        later = rows[times != self._times[rows]]
        self._stacks[later, 1:] = self._stacks[later, :-1]
        self._times[rows] = times
        self._stacks[rows, 0] = self._features(rows, observation)
        return self._stacks[rows].reshape(len(rows), -1)


class FlatFeatureBatch(FeatureBatch):
    """Batch of complete observations as vectors, in the order in which Gymnasium flattens them.

    Args:
        space: Observation space of the agent.
    """

    def __init__(self, space: spaces.Dict) -> None:
        self._keys = list(space.spaces)

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the complete observations as vectors (r, n)."""
        return np.concatenate([observation[key].reshape(len(rows), -1) for key in self._keys], axis=1)


class SequentialFeatureBatch(FeatureBatch):
    """Batch of n user-defined features, one for each episode, that are called one after another.

    Args:
        features: Features of each episode.
    """

    def __init__(self, features: Sequence[AgentFeatures]) -> None:
        self._features = features

    def reset(self, row: int) -> None:
        """Clear the values that the features store from the previous episode."""
        self._features[row].reset()

    def __call__(self, rows: Rows, observation: Observation) -> Vectors:
        """Return the feature vectors (r, m); see `FeatureBatch`."""
        return np.stack(
            [
                self._features[row]({key: values[number].copy() for key, values in observation.items()})
                for number, row in enumerate(rows.tolist())
            ]
        )


#: Batches of features by agent and name: functions of context, selector of grasps and number of episodes.
FEATURE_BATCHES: dict[str, dict[str, Callable[[PolicyContext, GraspSelectionBatch, int], FeatureBatch]]] = {
    "giver": {
        "giver": lambda context, *_: GiverFeatureBatch(context),
        "flat_giver": lambda *_: FlatFeatureBatch(giver_observation_space()),
    },
    "receiver": {
        "receiver": lambda context, *_: ReceiverFeatureBatch(context),
        "flat_receiver": lambda *_: FlatFeatureBatch(observation_space()),
        "grasp": lambda context, selection, _: GraspFeatureBatch(context, selection),
        "close": lambda context, selection, _: GraspProximityFeatureBatch(context, selection),
        "close_stack": lambda context, selection, count: StackedFeatureBatch(
            GraspProximityFeatureBatch(context, selection), count_features("receiver", "close"), count
        ),
    },
}


def _normalize(quaternions: npt.NDArray[np.floating]) -> Array:
    """Return unit quaternions (..., 4), float64."""
    wide = quaternions.astype(np.float64)
    unit: Array = wide / np.sqrt((wide**2).sum(axis=-1, keepdims=True))
    return unit


def _relative_columns(axes: Array, rotations: Array) -> Array:
    """Return the first two columns of rotations (r, 3, 3) in frames (r, 3, 3), row by row, (r, 6)."""
    columns: Array = rotate_to_frame(axes, rotations.swapaxes(1, 2))[:, :2].swapaxes(1, 2).reshape(len(axes), 6)
    return columns


def _one_hot_classes(observation: Observation) -> Vectors:
    classes = observation["object_classes"][:, :1].astype(int)
    return np.asarray(classes == np.arange(1, LARGEST_YCB_CLASS + 1), dtype=np.float32)
