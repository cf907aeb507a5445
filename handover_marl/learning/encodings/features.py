"""Feature vectors for small networks, computed from observations of many episodes at once.

Except in `FlatFeatures`, positions are in decimeters, or scaled as a class states, so that features are of order one.
Most are in the handover frame (see `compute_handover_frames`) or the gripper frame, that of the Panda's hand link, so
that they hardly depend on the world frame. Features of an episode do not depend on the other episodes.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

from gymnasium import spaces

from handover_marl.config import TIME_STEP
from handover_marl.episode.observations import Observation, giver_observation_space, state_space
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, get_namespace, stack_last, to_float64
from handover_marl.geometry.poses import IDENTITY
from handover_marl.geometry.rotations import (
    conjugate_quaternions,
    matrices_from_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    rotate_points,
    rotation_vectors_from_quaternions,
)
from handover_marl.geometry.vectors import compute_lengths
from handover_marl.geometry.ycb import LARGEST_YCB_CLASS
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.policies.policy import PolicyContext

#: Factors by which features scale positions, and translations to a grasp (1/m).
SCALE, GRASP_SCALE = 10.0, 5.0
#: Number of decisions whose features `StackedFeatures` contains.
N_STACKED = 4


class ArrayFeatures(ABC):
    """Base class of features: functions from observations to vectors of numbers, the inputs of a network.

    An object serves n episodes; a call computes the vectors of r of them.

    Args:
        context: Robot, task and known grasps of the objects.
        selector: Selector of the grasps that some features contain.
        count: Number n of episodes.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.

    Attributes:
        name: Name of the features in policy files.
        agent: Agent whose observations are used, "giver" or "receiver".
        size: Number of features.
        uses_camera: Whether the features may depend on the data of cameras.
    """

    name: str
    agent: str
    size: int
    uses_camera = False

    def __init__(
        self, context: PolicyContext, selector: LowestCostGraspSelector, count: int, arrays: ArrayFactory = NUMPY_ARRAYS
    ) -> None:
        self._selector, self._arrays = selector, arrays
        self._goal = arrays.asarray(context.protocol.goal_center)
        self._duration = context.protocol.horizon_steps * TIME_STEP
        self._classes = arrays.arange(LARGEST_YCB_CLASS) + 1
        self.allocate(count)

    def allocate(self, count: int) -> None:  # noqa: B027
        """Create a subclass's arrays (n, ...) for values of n = `count` episodes; called once, by the constructor."""

    def reset(self, row: int) -> None:  # noqa: B027
        """Clear the stored values of the finished episode with index `row`, so that the next one can use this row."""

    @abstractmethod
    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return feature vectors (r, size), float32, of the r episodes `rows`; `observation` has arrays (r, ...)."""


def compute_handover_frames(observation: Observation) -> tuple[AnyArray, AnyArray]:
    """Return r handover frames: x points horizontally towards the gripper, z up.

    Returns:
        Origins (r, 3) in the world (m): the objects' positions 0.5 s ahead in the recordings. Axes in the world, the
        columns of matrices (r, 3, 3).
    """
    origins = to_float64(observation["replay_object_poses"][:, -1, :3])
    xp, to_gripper = get_namespace(origins), observation["gripper_pose"][:, :2] - origins[:, :2]
    length = compute_lengths(to_gripper)
    is_long = length > 1e-6
    length = xp.where(is_long, length, 1.0)
    x, y = xp.where(is_long, to_gripper[:, 0] / length, 1.0), xp.where(is_long, to_gripper[:, 1] / length, 0.0)
    zeros, ones = xp.zeros_like(x), xp.ones_like(x)
    return origins, stack_last([x, -y, zeros, y, x, zeros, zeros, zeros, ones]).reshape(len(x), 3, 3)


def rotate_to_frame(axes: AnyArray, vectors: AnyArray) -> AnyArray:
    """Rotate vectors (r, ..., 3) from the world to r frames, whose axes are the columns of `axes` (r, 3, 3)."""
    matrix = axes.reshape(len(axes), *[1] * (vectors.ndim - 2), 3, 3)
    parts = [vectors[..., axis, None] * matrix[..., axis, :] for axis in range(3)]
    return parts[0] + parts[1] + parts[2]


def rotate_to_world(axes: AnyArray, vectors: AnyArray) -> AnyArray:
    """Rotate vectors (r, 3) to the world from r frames, whose axes are the columns of `axes` (r, 3, 3)."""
    return rotate_to_frame(axes.swapaxes(1, 2), vectors)


class GiverFeatures(ArrayFeatures):
    """Features (39) from which a giver can choose a handover pose.

    In the frame of `compute_handover_frames`, in dm: horizontal distance and height of the gripper (both minus 5);
    position of the frame's origin minus the goal (along the world's axes); wrist position, mean position of the finger
    joints and object orientation (first two columns of its rotation matrix) 0.5 s ahead in the recording. Then follow
    whether the object was released, and the YCB class of the object (one-hot; zeros for another class).
    """

    name, agent, size = "giver", "giver", 18 + LARGEST_YCB_CLASS

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the features (r, 39) of the episodes with indices `rows`, whose observations have arrays (r, ...)."""
        origins, axes = compute_handover_frames(observation)
        xp, wrists = get_namespace(origins), to_float64(observation["replay_wrist_poses"][:, -1, :3])
        later = normalize_quaternions(to_float64(observation["replay_object_poses"][:, -1, 3:]))
        # The fingers keep their position relative to the object until then.
        now = to_float64(observation["object_poses"][:, 0])
        fingers = xp.mean(to_float64(observation["hand_keypoints"][:, 1:]), axis=1) - now[:, :3]
        fingers = rotate_points(conjugate_quaternions(normalize_quaternions(now[:, 3:])), fingers)
        gripper = observation["gripper_pose"][:, :3] - origins
        orientation = matrices_from_quaternions(later)
        parts = [
            SCALE * xp.stack([compute_lengths(gripper[:, :2]), gripper[:, 2]], axis=1) - 5.0,
            SCALE * (origins - self._goal),
            SCALE * rotate_to_frame(axes, wrists - origins),
            SCALE * rotate_to_frame(axes, rotate_points(later, fingers)),
            _relative_columns(axes, orientation),
            observation["released"],
            _one_hot_classes(observation, self._classes),
        ]
        return xp.astype(xp.concat(parts, axis=1), xp.float32)


class ReceiverFeatures(ArrayFeatures):
    """Features (56) from which a receiver can take an object to the goal.

    In the gripper frame: positions (m, times 5) of the object, the person's wrist, the mean of the person's finger
    joints (zeros without a hand) and the goal; the object's orientation (first two columns of its rotation matrix, row
    by row); and the world's vertical. Then follow the robot's finger joints (m, times 50, minus 1) and their velocities
    (m/s, times 10), arm joints (rad), whether the object was released, the elapsed share of the time limit, whether a
    hand is present, and the object's YCB class (one-hot; zeros for others).
    """

    name, agent, size = "receiver", "receiver", 35 + LARGEST_YCB_CLASS

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the features (r, 56) of the episodes with indices `rows`, whose observations have arrays (r, ...)."""
        gripper, items = to_float64(observation["gripper_pose"]), to_float64(observation["object_poses"])
        xp, axes = get_namespace(gripper), matrices_from_quaternions(gripper[:, 3:])
        keypoints = to_float64(observation["hand_keypoints"])
        hand = xp.stack([keypoints[:, 0], xp.mean(keypoints[:, 1:], axis=1)], axis=1)
        hand = xp.where(observation["hand_present"][..., None] != 0.0, hand, gripper[:, None, :3])
        goal = xp.broadcast_to(self._goal, (len(rows), 1, 3))
        positions = xp.concat([items[:, :1, :3], hand, goal], axis=1) - gripper[:, None, :3]
        joints, velocities = observation["robot_joint_position"], observation["robot_joint_velocity"]
        parts = [
            rotate_to_frame(axes, 0.5 * SCALE * positions).reshape(len(rows), -1),
            _relative_columns(axes, matrices_from_quaternions(items[:, 0, 3:])),
            axes[:, 2],
            50.0 * joints[:, 7:] - 1.0,
            10.0 * velocities[:, 7:],
            joints[:, :7],
            observation["released"],
            observation["time"] / self._duration,
            observation["hand_present"],
            _one_hot_classes(observation, self._classes),
        ]
        return xp.astype(xp.concat(parts, axis=1), xp.float32)


class GraspFeatures(ReceiverFeatures):
    """Features (64): the 56 of `ReceiverFeatures`, then 8 of the grasp that `LowestCostGraspSelector` chooses.

    The latter are, in the gripper frame: translation to the grasp (3, m times `GRASP_SCALE`), rotation vector to it (3,
    rad), clearance between gripper and person's hand at the grasp and on the straight approach to it (1, dm), and
    whether grasps of the object are known (1).
    """

    name, size = "grasp", ReceiverFeatures.size + 8

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the features (r, 64) of the episodes with indices `rows`; the 8 of the grasp are last."""
        vectors = [super().__call__(rows, observation), self.compute_grasp_features(rows, observation)]
        return get_namespace(vectors[0]).concat(vectors, axis=1)

    def compute_grasp_features(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the 8 grasp features (r, 8) of the episodes with indices `rows`; zeros where no grasp is known."""
        grasps, clearances, exists = self._selector.select(rows, observation)
        xp, gripper = get_namespace(grasps), to_float64(observation["gripper_pose"])
        grasps = xp.where(exists[:, None], grasps, self._arrays.asarray(IDENTITY.copy()))
        gripper_from_world = conjugate_quaternions(normalize_quaternions(gripper[:, 3:]))
        gripper_from_grasp = multiply_quaternions(gripper_from_world, normalize_quaternions(grasps[:, 3:]))
        rotation = rotation_vectors_from_quaternions(gripper_from_grasp)
        translation = GRASP_SCALE * rotate_points(gripper_from_world, grasps[:, :3] - gripper[:, :3])
        others = xp.stack([10.0 * clearances, xp.ones_like(clearances)], axis=1)
        parts = xp.concat([translation, rotation, others], axis=1)
        return xp.astype(xp.where(exists[:, None], parts, 0.0), xp.float32)


class GraspVelocityFeatures(GraspFeatures):
    """Features (70): the 64 of `GraspFeatures`, then 6 velocities, averaged since the last decision.

    These are the velocities of the object to hand over and of the person's wrist, along the gripper frame's axes (m/s,
    times 5, clipped to [-5, 5]); zeros at the first decision of an episode. A missing hand counts as one at the origin.
    The gripper's own velocity is left out: a network that imitates another policy would continue the gripper's motion.
    """

    name, size = "grasp_velocity", GraspFeatures.size + 6

    def allocate(self, count: int) -> None:
        """Create arrays for the positions, times and velocities of the last decisions in n = `count` episodes."""
        arrays = self._arrays
        self._positions, self._velocities = arrays.zeros((count, 2, 3)), arrays.zeros((count, 2, 3))
        self._times = arrays.full(count, -1.0)

    def reset(self, row: int) -> None:
        """Set the velocities of the episode with index `row` to zero, because a new episode starts."""
        self._velocities[row], self._times[row] = 0.0, -1.0

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the features (r, 70) of the episodes `rows`; calls at the same time have equal velocities."""
        times, gripper = to_float64(observation["time"][:, 0]), to_float64(observation["gripper_pose"])
        xp, axes, parts = (
            get_namespace(times),
            matrices_from_quaternions(gripper[:, 3:]),
            ("object_poses", "hand_keypoints"),
        )
        positions = xp.stack([to_float64(observation[key][:, 0, :3]) for key in parts], axis=1)
        later = xp.nonzero(times != self._times[rows])[0]
        known = later[self._times[rows[later]] >= 0.0]
        moved = positions[known] - self._positions[rows[known]]
        self._velocities[rows[known]] = moved / (times[known] - self._times[rows[known]])[:, None, None]
        self._positions[rows[later]], self._times[rows[later]] = positions[later], times[later]
        velocities = rotate_to_frame(axes, 5.0 * self._velocities[rows]).reshape(len(rows), 6).clip(-5.0, 5.0)
        return xp.concat([super().__call__(rows, observation), xp.astype(velocities, xp.float32)], axis=1)


class GraspProximityFeatures(GraspFeatures):
    """Features (12) that suffice to decide when to close the gripper.

    The first six are translation (m times `GRASP_SCALE`) and rotation vector (rad), in the gripper frame, to the grasp
    that `LowestCostGraspSelector` chooses. Two are proximities of position and orientation, exp(-distance / scale),
    which are 1 at the grasp. Two are the robot's finger joints q as 50 q - 1 (q in m). The last two are flags: whether
    the object was released, and whether grasps of the object are known; if not, all features of the grasp are 0.

    Attributes:
        position_scale: Distance from the grasp at which the proximity of the position is 1/e (m).
        angle_scale: Angle to the grasp at which the proximity of the orientation is 1/e (rad).
    """

    name, size = "close", 12
    position_scale, angle_scale = 0.03, 0.2

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the features (r, 12) of the episodes with indices `rows`, whose observations have arrays (r, ...)."""
        grasp = self.compute_grasp_features(rows, observation)
        xp = get_namespace(grasp)
        translation, rotation, exists = grasp[:, :3], grasp[:, 3:6], grasp[:, 7:]
        distance, angle = (to_float64(compute_lengths(vectors)[:, None]) for vectors in (translation, rotation))
        near = xp.exp(-distance / GRASP_SCALE / self.position_scale)
        aligned = xp.exp(-angle / self.angle_scale)
        fingers = 50.0 * observation["robot_joint_position"][:, 7:] - 1.0
        parts = [translation, rotation, near * exists, aligned * exists, fingers, observation["released"], exists]
        return xp.astype(xp.concat(parts, axis=1), xp.float32)


class StackedFeatures(GraspProximityFeatures):
    """Features (48): the 12 of `GraspProximityFeatures` at the last `N_STACKED` decisions, the present one first.

    Zeros take the place of decisions before the first. From these features, a policy without memory can estimate
    velocities and how the giver reacts.
    """

    name, size = "close_stack", N_STACKED * GraspProximityFeatures.size

    def allocate(self, count: int) -> None:
        """Create the stacked features of n = `count` episodes, all zero."""
        arrays = self._arrays
        self._stacks = arrays.zeros((count, N_STACKED, GraspProximityFeatures.size), "float32")
        self._times = arrays.full(count, -1.0)

    def reset(self, row: int) -> None:
        """Set the stacked features of the episode with index `row` to zero, because a new episode starts."""
        self._stacks[row], self._times[row] = 0.0, -1.0

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return features (r, N_STACKED * 12) of the episodes `rows`; calls at the same time count as one decision."""
        times = to_float64(observation["time"][:, 0])
        later = rows[times != self._times[rows]]
        self._stacks[later, 1:] = self._stacks[later, :-1]
        self._times[rows] = times
        self._stacks[rows, 0] = super().__call__(rows, observation)
        return self._stacks[rows].reshape(len(rows), -1)


class FlatFeatures(ArrayFeatures):
    """Complete observations as vectors, in the order in which Gymnasium and Stable-Baselines3 flatten them.

    Attributes:
        keys: Keys of the observation in this order.
    """

    keys: ClassVar[tuple[str, ...]]

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the observations of the episodes with indices `rows` as vectors (r, size)."""
        parts = [observation[key].reshape(len(rows), -1) for key in self.keys]
        return get_namespace(*parts).concat(parts, axis=1)


class FlatGiverFeatures(FlatFeatures):
    """Complete observations of the giver as vectors."""

    name, agent = "flat_giver", "giver"
    keys, size = tuple(giver_observation_space()), spaces.flatdim(giver_observation_space())


class FlatReceiverFeatures(FlatFeatures):
    """Complete observations of the receiver in the mode "state" as vectors."""

    name, agent = "flat_receiver", "receiver"
    keys, size = tuple(state_space()), spaces.flatdim(state_space())


def _relative_columns(axes: AnyArray, rotations: AnyArray) -> AnyArray:
    """Return the first two columns (r, 6), row by row, of world rotations (r, 3, 3) in r frames.

    The columns of `axes` (r, 3, 3) are the axes of the frames in the world.
    """
    return rotate_to_frame(axes, rotations.swapaxes(1, 2))[:, :2].swapaxes(1, 2).reshape(len(axes), 6)


def _one_hot_classes(observation: Observation, classes: AnyArray) -> AnyArray:
    xp = get_namespace(classes)
    return xp.astype(xp.astype(observation["object_classes"][:, :1], xp.int64) == classes, xp.float32)
