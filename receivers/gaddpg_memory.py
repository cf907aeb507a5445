"""What GA-DDPG keeps of what it saw, and what it makes its network's input of."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: Six points of the gripper (columns) in the hand link's frame (m), twice the wrist, then fingers; they lead the input.
FINGER_POINTS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.053, -0.053, 0.053, -0.053],
        [0.0, 0.0, 0.075, 0.075, 0.105, 0.105],
    ]
)


@dataclass(frozen=True)
class MemoryConfig:
    """Constants of what is remembered, as HandoverSim sets them.

    Attributes:
        n_points: Points of the network's input, without those of the gripper.
        max_steps: Decisions that an approach may take.
        thinning: Share of `n_points` that is kept of a cloud, to the power of the decisions that were taken.
        moved: How far the mean of the cloud must have moved between two looks for more time (m).
        more_steps: How many decisions that gives, up to `max_steps` in all.
        cage_lower: Lower corner of the space between the fingers in the hand link's frame (m), exclusive.
        cage_upper: Its upper corner, exclusive.
        cage_points: More points than this of `n_points` in there end the approach.
        seed: What points are drawn with in every episode.
    """

    n_points: int = 1024
    max_steps: int = 20
    thinning: float = 0.95
    moved: float = 0.1
    more_steps: int = 5
    cage_lower: tuple[float, float, float] = (-0.02, -0.05, 0.06)
    cage_upper: tuple[float, float, float] = (0.02, 0.05, 0.11)
    cage_points: int = 50
    seed: int = 123456


@dataclass
class PointMemory:
    """The object's last cloud and how many decisions are left. The scripts call the cloud accumulated; it never is.

    Attributes:
        config: Its constants.
        remaining: Decisions left.
        cloud: (3, n) float64 in the robot's base frame (m); no columns until something was seen.
    """

    config: MemoryConfig = field(default_factory=MemoryConfig)
    remaining: int = field(init=False)
    cloud: Array = field(init=False)

    def __post_init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start an episode."""
        self.remaining = self.config.max_steps
        self.cloud = np.zeros((3, 0))
        self._mean = np.zeros(3)
        # NumPy's older kind of generator: the scripts seed the global one, and all depends on its bits.
        self._rng = np.random.RandomState(self.config.seed)

    def see(self, points: npt.NDArray[np.float32], base_from_hand: Array) -> None:
        """Take in what is seen of the object; nothing seen changes nothing.

        Args:
            points: (n, 3) float32 in the hand link's frame (m), in the camera's order.
            base_from_hand: (4, 4) pose of the hand link in the robot's base frame.
        """
        if len(points) == 0:
            return
        config, taken = self.config, self.config.max_steps - self.remaining
        seen = _transformed(base_from_hand, points.T)
        kept = min(int(config.thinning**taken * config.n_points), seen.shape[1])
        self.cloud = seen[:, self._rng.choice(seen.shape[1], kept, replace=False)].astype(np.float64)
        mean = self.cloud.mean(axis=1)
        if np.linalg.norm(self._mean - mean) > config.moved:
            self.remaining = min(self.remaining + config.more_steps, config.max_steps)
        self._mean = mean

    def network_input(self, base_from_hand: Array) -> Array:
        """(4, 6 + n_points) float64: gripper and cloud in the present hand frame (m), and 1 for the gripper's."""
        hand = _transformed(_rounded_inverse(base_from_hand), self.cloud)
        points = np.zeros((4, FINGER_POINTS.shape[1] + self.config.n_points))
        points[:3] = np.concatenate([FINGER_POINTS, self._filled_up(hand)], axis=1)
        points[3, : FINGER_POINTS.shape[1]] = 1.0
        return points

    def caged(self, base_from_hand: Array) -> bool:
        """Whether enough of the last cloud is between the fingers; it draws, and no points are no cage."""
        if self.cloud.shape[1] == 0:
            return False
        hand = _transformed(_rounded_inverse(base_from_hand), self.cloud)
        lower, upper = (np.array(corner)[:, None] for corner in (self.config.cage_lower, self.config.cage_upper))
        inside = np.logical_and.reduce((hand > lower) & (hand < upper), axis=0, keepdims=True)
        return bool(self._filled_up(inside).sum() > self.config.cage_points)

    def _filled_up(self, columns: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(m, n_points) of at most as many columns: repeats of them, drawn at random, behind them."""
        count = columns.shape[1]
        lacking = self.config.n_points - count
        if lacking == 0:
            return columns
        return np.concatenate([columns, columns[:, self._rng.choice(count, lacking)]], axis=1)


def _transformed(a_from_b: npt.NDArray[np.floating], points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Points (3, n) of frame b in frame a, in their own precision; three points alone are left in double."""
    moved: npt.NDArray[np.floating] = a_from_b[:3, :3].dot(points) + a_from_b[:3, [3]]
    return moved if points.shape[1] == 3 else moved.astype(points.dtype)


def _rounded_inverse(a_from_b: Array) -> npt.NDArray[np.float32]:
    """(4, 4) float32 inverse of a rigid pose."""
    inverse = np.eye(4, dtype=np.float32)
    inverse[:3, :3] = a_from_b[:3, :3].T
    inverse[:3, 3] = -a_from_b[:3, :3].T.dot(a_from_b[:3, 3])
    return inverse
