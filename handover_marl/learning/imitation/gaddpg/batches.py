"""Batches of imitation states as tensors, augmented by random changes of the pose of the robot's hand.

PointNet++ groups points around sampled centers. The groups depend on the distances between points only, so that they
are those of the stored cloud. Each point counts once in a group; the deployed network repeats points to fill groups,
which does not change its output.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from handover_marl.geometry.poses import IDENTITY, compose, invert_pose
from handover_marl.learning.imitation.gaddpg.data_generation import ImitationStates
from handover_marl.learning.imitation.gaddpg.expert import EXPERT_SPARE_STEPS
from handover_marl.learning.networks.approach_field import compute_approach_steps
from handover_marl.learning.networks.point_encoders import GADDPG_GROUPINGS, sample_farthest_points


class ImitationBatch(NamedTuple):
    """Tensors of B imitation states with N points and M centers of groups.

    The hands are the Panda's hand link.

    Attributes:
        points: (B, N, 3) points in the hands' frames (m).
        centers: (B, M) indices of those points that are centers of groups.
        is_center: (B, M) whether a center is not the same point as an earlier one.
        neighbors: (B, M, N) whether a point is in the group of a center.
        center_neighbors: (B, M, M) whether the second center is in the group of centers around the first.
        remaining: (B,) numbers of decisions that remain in the approach.
        steps: (B, 6) motions of the hand by the expert's next decision, in the hands' frames:
            translation (m) and extrinsic xyz Euler angles (rad).
        goals: (B, 7) poses of the hand link at the grasps, in the hands' frames: xyz (m) and quaternion xyzw.
    """

    points: Tensor
    centers: Tensor
    is_center: Tensor
    neighbors: Tensor
    center_neighbors: Tensor
    remaining: Tensor
    steps: Tensor
    goals: Tensor

    def to(self, device: torch.device) -> "ImitationBatch":
        """Return a copy of the batch on a device."""
        return ImitationBatch(*(value.to(device) for value in self))


# Standard deviations of the augmentation, a change of the hand's pose: displacement along each axis (m) and rotation
# about each axis (rad). The point cloud still shows what was visible from the stored pose.
_POSITION_STD, _ROTATION_STD = 0.012, 0.05
# Largest random change of the number of remaining decisions, with which the expert's step changes, and the largest
# number after the change.
_COUNTER_RANGE, _MAX_REMAINING = 6, 20


class ImitationBatches:
    """Data set of imitation states from which batches are selected.

    Args:
        states: States of the data set.
        max_neighbors: Largest number of points of a group; further points are dropped.
    """

    def __init__(self, states: ImitationStates, max_neighbors: int = 32) -> None:
        self._states, self._max_neighbors = states, max_neighbors

    def __len__(self) -> int:
        return len(self._states.remaining)

    def sample(self, count: int, rng: np.random.Generator) -> ImitationBatch:
        """Draw a batch of `count` states with replacement; vary poses of the robot's hand and remaining decisions."""
        return self.select(rng.integers(len(self), size=count), rng)

    def select(self, numbers: npt.NDArray[np.int_], rng: np.random.Generator | None) -> ImitationBatch:
        """Return a batch of the states with the indices `numbers` (B,), augmented unless `rng` is None."""
        stored, n_points, goals, counters = (array[numbers] for array in self._states)
        remaining, hands = counters.astype(np.float32), np.tile(IDENTITY, (len(numbers), 1))
        points = torch.from_numpy(stored.astype(np.float32))
        groups = _group_points(points, torch.from_numpy(n_points), self._max_neighbors)
        if rng is not None:
            hands, remaining = _augment(remaining, rng)
        rotations = torch.from_numpy(Rotation.from_quat(hands[:, 3:]).as_matrix().astype(np.float32))
        offsets = points - torch.from_numpy(hands[:, None, :3].astype(np.float32))
        goals = compose(invert_pose(hands), goals.astype(np.float64))
        present = np.tile(IDENTITY, (len(numbers), 1))
        steps = compute_approach_steps(present, goals, remaining.astype(np.float64), EXPERT_SPARE_STEPS)
        labels = (torch.from_numpy(array.astype(np.float32)) for array in (remaining, steps, goals))
        return ImitationBatch(offsets @ rotations, *groups, *labels)


def _augment(
    remaining: npt.NDArray[np.float32], rng: np.random.Generator
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return random poses (B, 7) of the hands in their stored frames, and changed counters of decisions (B,)."""
    count = len(remaining)
    quaternions = Rotation.from_rotvec(rng.normal(0.0, _ROTATION_STD, (count, 3))).as_quat()
    hands = np.concatenate([rng.normal(0.0, _POSITION_STD, (count, 3)), quaternions], axis=1)
    changed = remaining + rng.integers(-_COUNTER_RANGE, _COUNTER_RANGE + 1, count)
    return hands, np.clip(changed, 1, _MAX_REMAINING).astype(np.float32)


def _group_points(points: Tensor, n_points: Tensor, max_neighbors: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return `centers` to `center_neighbors` of `ImitationBatch` for clouds (B, N, 3) of `n_points` (B,) points."""
    first, second = GADDPG_GROUPINGS
    # Zeros after the valid points are never sampled.
    centers = sample_farthest_points(points, first.centers)
    is_center = ~(centers[:, :, None] == centers[:, None]).tril(-1).any(dim=-1)
    positions = points.gather(1, centers[..., None].expand(-1, -1, 3))
    is_valid = torch.arange(points.shape[1]) < n_points[:, None]
    near, near_centers = (
        _query_ball(positions, others, valid, grouping.radius, min(grouping.neighbors, max_neighbors))
        & is_center[..., None]
        for others, valid, grouping in ((points, is_valid, first), (positions, is_center, second))
    )
    return centers, is_center, near, near_centers


def _query_ball(centers: Tensor, points: Tensor, is_valid: Tensor, radius: float, count: int) -> Tensor:
    """Return a mask (B, M, N) of the first `count` valid points (B, N, 3) within a radius (m) of centers (B, M, 3)."""
    squared = ((centers[:, :, None] - points[:, None]) ** 2).sum(dim=-1)
    near = (squared < points.new_tensor(radius) ** 2) & is_valid[:, None]
    return near & (near.cumsum(dim=-1) <= count)
