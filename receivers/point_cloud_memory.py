"""Memory of GA-DDPG: the last point cloud of the object, and the input of its network."""

from typing import Any

import numpy as np
import numpy.typing as npt

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


# Values of HandoverSim. Number of points in the network's input besides the gripper's; base of the share of them that
# is kept of a cloud, with the number of decisions until then as exponent.
_N_POINTS, _THINNING = 1024, 0.95
# Motion of the cloud's mean between two views (m) above which decisions are added, and their number.
_MOTION_THRESHOLD, _EXTRA_STEPS = 0.1, 5
# Corners of the region between the fingers in the hand link's frame (m), exclusive, and number of points in it that
# must be exceeded to end the approach.
_CAGE_LOWER, _CAGE_UPPER, _CAGE_POINTS = (-0.02, -0.05, 0.06), (0.02, 0.05, 0.11), 50


class PointCloudMemory:
    """Memory of the object's last point cloud and of the number of remaining decisions.

    The authors' scripts call the cloud accumulated, but each view replaces the cloud.

    Args:
        max_steps: Maximum number of decisions of an approach.
        seed: Seed of the random selection of points, the same in every episode.

    Attributes:
        remaining: Number of decisions that remain for the approach.
        cloud: (3, n) float64 points in the robot's base frame (m), without columns before the first view of the object.
    """

    def __init__(self, max_steps: int = 20, seed: int = 123456) -> None:
        self._max_steps, self._seed = max_steps, seed
        self.reset()

    def reset(self) -> None:
        """Forget the cloud and restart the count of decisions, at the start of an episode."""
        self.remaining, self.cloud = self._max_steps, np.zeros((3, 0))
        self._mean = np.zeros(3)
        # The scripts seed NumPy's global legacy generator, on whose bits everything depends.
        self._rng = np.random.RandomState(self._seed)

    def update(self, points: npt.NDArray[np.float32], base_from_hand: Array) -> None:
        """Replace the cloud by the object's points (n, 3) float32 in the hand's frame; none change nothing.

        `base_from_hand` is the pose (4, 4) of the hand link in the robot's base frame.
        """
        if len(points) == 0:
            return
        transformed = _transform(base_from_hand, points.T)
        kept = min(int(_THINNING ** (self._max_steps - self.remaining) * _N_POINTS), transformed.shape[1])
        columns = self._rng.choice(transformed.shape[1], kept, replace=False)
        self.cloud = transformed[:, columns].astype(np.float64)
        mean = self.cloud.mean(axis=1)
        if np.linalg.norm(self._mean - mean) > _MOTION_THRESHOLD:
            self.remaining = min(self.remaining + _EXTRA_STEPS, self._max_steps)
        self._mean = mean

    def make_network_input(self, base_from_hand: Array) -> Array:
        """Return the network's input: points of gripper and object in the hand link's frame.

        Returns:
            (4, 6 + n_points) float64 positions (m), and a row that is 1 for gripper points.
        """
        hand = _transform(_invert_rounded(base_from_hand), self.cloud)
        points = np.zeros((4, GRIPPER_POINTS.shape[1] + _N_POINTS))
        points[:3] = np.concatenate([GRIPPER_POINTS, self._fill_up(hand)], axis=1)
        points[3, : GRIPPER_POINTS.shape[1]] = 1.0
        return points

    def is_object_caged(self, base_from_hand: Array) -> bool:
        """Return whether enough object points, drawn at random, are between the fingers."""
        if self.cloud.shape[1] == 0:
            return False
        hand = _transform(_invert_rounded(base_from_hand), self.cloud)
        lower, upper = (np.array(corner)[:, None] for corner in (_CAGE_LOWER, _CAGE_UPPER))
        inside = np.logical_and.reduce((hand > lower) & (hand < upper), axis=0, keepdims=True)
        return bool(self._fill_up(inside).sum() > _CAGE_POINTS)

    def _fill_up(self, columns: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return (m, n_points) columns: all of the given ones, then random repetitions."""
        count = columns.shape[1]
        missing = _N_POINTS - count
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
