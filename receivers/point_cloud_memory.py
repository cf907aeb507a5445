"""Memory of GA-DDPG: the last point cloud of the object, and the input of its network."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import CheckedConfig, bounded

Array = npt.NDArray[np.float64]

#: Six points of the gripper (columns) in the hand link's frame (m), twice the wrist, then the
#: fingers; they are the first columns of the network's input.
GRIPPER_POINTS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.053, -0.053, 0.053, -0.053],
        [0.0, 0.0, 0.075, 0.075, 0.105, 0.105],
    ]
)


@dataclass(frozen=True)
class PointCloudMemoryConfig(CheckedConfig):
    """Configuration of the point cloud memory of GA-DDPG, as in HandoverSim.

    Attributes:
        n_points: Number of points in the network's input, in addition to the gripper's points.
        max_steps: Maximum number of decisions of an approach.
        thinning: Base of the share of `n_points` that is kept of a cloud; the exponent is the
            number of decisions until then.
        motion_threshold: Motion of the cloud's mean between two views above which the receiver may
            make more decisions (m).
        extra_steps: Number of decisions that are added after a motion above `motion_threshold`, up
            to `max_steps` in total.
        cage_lower: Lower corner of the region between the fingers in the hand link's frame (m), exclusive.
        cage_upper: Upper corner of the region between the fingers in the hand link's frame (m), exclusive.
        cage_points: Number of points between the fingers that must be exceeded to end the approach.
        seed: Seed of the random selection of points, the same in every episode.
    """

    n_points: int = bounded(1024, 1)
    max_steps: int = bounded(20, 0)
    thinning: float = bounded(0.95, 0.0, 1.0)
    motion_threshold: float = bounded(0.1, 0)
    extra_steps: int = bounded(5, 0)
    cage_lower: tuple[float, float, float] = (-0.02, -0.05, 0.06)
    cage_upper: tuple[float, float, float] = (0.02, 0.05, 0.11)
    cage_points: int = bounded(50, 0)
    seed: int = bounded(123456, 0)


@dataclass
class PointCloudMemory:
    """Memory of the object's last point cloud and of the number of remaining decisions.

    The authors' scripts call the cloud accumulated, but each view replaces the cloud.

    Attributes:
        config: Configuration of the memory.
        remaining: Number of decisions that remain for the approach.
        cloud: (3, n) float64 points in the robot's base frame (m), without columns before the first view of the object.
    """

    config: PointCloudMemoryConfig = field(default_factory=PointCloudMemoryConfig)
    remaining: int = field(init=False)
    cloud: Array = field(init=False)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the cloud and restart the count of decisions, at the start of an episode."""
        self.remaining = self.config.max_steps
        self.cloud = np.zeros((3, 0))
        self._mean = np.zeros(3)
        # The scripts seed NumPy's global legacy generator, on whose bits everything depends.
        self._rng = np.random.RandomState(self.config.seed)

    def update(self, points: npt.NDArray[np.float32], base_from_hand: Array) -> None:
        """Replace the cloud by the object's points (n, 3) float32 in the hand's frame; none change nothing.

        `base_from_hand` is the pose (4, 4) of the hand link in the robot's base frame.
        """
        if len(points) == 0:
            return
        config, decisions = self.config, self.config.max_steps - self.remaining
        transformed = _transform(base_from_hand, points.T)
        kept = min(int(config.thinning**decisions * config.n_points), transformed.shape[1])
        columns = self._rng.choice(transformed.shape[1], kept, replace=False)
        self.cloud = transformed[:, columns].astype(np.float64)
        mean = self.cloud.mean(axis=1)
        if np.linalg.norm(self._mean - mean) > config.motion_threshold:
            self.remaining = min(self.remaining + config.extra_steps, config.max_steps)
        self._mean = mean

    def make_network_input(self, base_from_hand: Array) -> Array:
        """Return the network's input: points of gripper and object in the hand link's frame.

        Returns:
            (4, 6 + n_points) float64 positions (m), and a row that is 1 for gripper points.
        """
        hand = _transform(_invert_rounded(base_from_hand), self.cloud)
        points = np.zeros((4, GRIPPER_POINTS.shape[1] + self.config.n_points))
        points[:3] = np.concatenate([GRIPPER_POINTS, self._fill_up(hand)], axis=1)
        points[3, : GRIPPER_POINTS.shape[1]] = 1.0
        return points

    def is_object_caged(self, base_from_hand: Array) -> bool:
        """Return whether enough object points, drawn at random, are between the fingers."""
        if self.cloud.shape[1] == 0:
            return False
        hand = _transform(_invert_rounded(base_from_hand), self.cloud)
        lower, upper = (np.array(corner)[:, None] for corner in (self.config.cage_lower, self.config.cage_upper))
        inside = np.logical_and.reduce((hand > lower) & (hand < upper), axis=0, keepdims=True)
        return bool(self._fill_up(inside).sum() > self.config.cage_points)

    def _fill_up(self, columns: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return (m, n_points) columns: all of the given ones, then random repetitions."""
        count = columns.shape[1]
        missing = self.config.n_points - count
        if missing == 0:
            return columns
        return np.concatenate([columns, columns[:, self._rng.choice(count, missing)]], axis=1)


def _transform(a_from_b: npt.NDArray[np.floating], points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return points (3, n) of frame b in frame a, in their own precision.

    Exactly three points stay in double precision, as in the original scripts.
    """
    moved: npt.NDArray[np.floating] = a_from_b[:3, :3].dot(points) + a_from_b[:3, [3]]
    return moved if points.shape[1] == 3 else moved.astype(points.dtype)


def _invert_rounded(a_from_b: Array) -> npt.NDArray[np.float32]:
    """Return the float32 inverse (4, 4) of a rigid transform."""
    inverse = np.eye(4, dtype=np.float32)
    inverse[:3, :3] = a_from_b[:3, :3].T
    inverse[:3, 3] = -a_from_b[:3, :3].T.dot(a_from_b[:3, 3])
    return inverse
