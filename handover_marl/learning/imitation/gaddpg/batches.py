"""Batches of imitation states as tensors, augmented by random changes of the hand's pose."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from handover_marl.geometry.poses import IDENTITY, compose, invert_pose
from handover_marl.learning.imitation.gaddpg.states import ImitationStates
from handover_marl.learning.networks.approach_field import ApproachFieldConfig, compute_approach_steps


@dataclass(frozen=True, eq=False)
class ImitationBatch:
    """Tensors of B imitation states; indices refer to the points and centers of the whole batch.

    Attributes:
        points: (P, 3) points of all states, each in the frame of its state's hand link (m).
        centers: (C,) indices of the centers of groups, among all points.
        neighbors: (N,) indices of the points of the groups, among all points.
        n_neighbors: (C,) numbers of points of the groups.
        center_neighbors: (M,) indices of the centers in groups of groups, among all centers.
        n_center_neighbors: (C,) numbers of centers of the groups of groups.
        n_centers: (B,) numbers of centers of the states.
        remaining: (B,) numbers of decisions that remain in the approach.
        steps: (B, 6) motions of the hand by the expert's next decision, in the hands' frames:
            translation (m) and extrinsic xyz Euler angles (rad).
        goals: (B, 7) poses of the hand link at the grasps, in the hands' frames: xyz (m) and
            quaternion xyzw.
    """

    points: Tensor
    centers: Tensor
    neighbors: Tensor
    n_neighbors: Tensor
    center_neighbors: Tensor
    n_center_neighbors: Tensor
    n_centers: Tensor
    remaining: Tensor
    steps: Tensor
    goals: Tensor

    def to(self, device: torch.device) -> "ImitationBatch":
        """Return a copy of the batch on a device."""
        return ImitationBatch(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class StateAugmentationConfig:
    """Configuration of the augmentation of imitation states by random changes of the hand's pose.

    The point cloud still shows what was visible from the stored pose.

    Attributes:
        position_std: Standard deviation of the hand's displacement along each axis (m).
        rotation_std: Standard deviation of the hand's rotation about each axis (rad).
        counter_range: Largest random change of the number of remaining decisions; the expert's step
            changes with this number.
        max_remaining: Largest number of remaining decisions after the change.
        max_neighbors: Largest number of points of a group; further points are dropped.
    """

    position_std: float = 0.012
    rotation_std: float = 0.05
    counter_range: int = 6
    max_remaining: int = 20
    max_neighbors: int = 32


def _offsets(counts: npt.NDArray[np.int32]) -> npt.NDArray[np.int_]:
    return np.concatenate([[0], np.cumsum(counts)])


def _gather_ragged(
    values: npt.NDArray[np.generic], firsts: npt.NDArray[np.int_], numbers: npt.NDArray[np.int_]
) -> npt.NDArray[np.int64]:
    """Return the concatenated rows of some states, whose rows begin at `firsts`; integers become int64."""
    rows: npt.NDArray[np.int64] = np.concatenate([values[firsts[number] : firsts[number + 1]] for number in numbers])
    return rows if rows.dtype == np.float16 else rows.astype(np.int64)


def _truncate_groups(
    values: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], most: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return at most the first `most` values of each group, and their numbers."""
    ranks = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
    return values[ranks < most], np.minimum(counts, most)


def _transform_to_hands(
    hands: npt.NDArray[np.float64], points: npt.NDArray[np.float32], counts: npt.NDArray[np.int32]
) -> npt.NDArray[np.float32]:
    """Return points (P, 3), `counts` (B,) for each state, in the frames of poses (B, 7)."""
    rotations = np.repeat(Rotation.from_quat(hands[:, 3:]).as_matrix(), counts, axis=0).astype(np.float32)
    offsets = points - np.repeat(hands[:, :3], counts, axis=0).astype(np.float32)
    transformed: npt.NDArray[np.float32] = np.einsum("pi,pij->pj", offsets, rotations)
    return transformed


class ImitationBatches:
    """Data set of imitation states from which batches are selected.

    Args:
        states: Stored states.
        approach: Rule by which the expert's steps follow from hand pose, grasp and remaining decisions.
        config: Configuration of the augmentation.
    """

    def __init__(self, states: ImitationStates, approach: ApproachFieldConfig, config: StateAugmentationConfig) -> None:
        self._states, self._approach, self._config = states, approach, config
        self._first_points, self._first_centers = _offsets(states.n_points), _offsets(states.n_centers)
        self._first_neighbors = _offsets(states.n_neighbors)[self._first_centers]
        self._first_center_neighbors = _offsets(states.n_center_neighbors)[self._first_centers]

    def select(self, numbers: npt.NDArray[np.int_], rng: np.random.Generator | None) -> ImitationBatch:
        """Return a batch of the states with given indices (B,), augmented if `rng` is not None."""
        states = self._states
        n_points, n_centers = states.n_points[numbers], states.n_centers[numbers]
        point_offsets = np.repeat(np.cumsum(n_points) - n_points, n_centers)
        center_offsets = np.repeat(np.cumsum(n_centers) - n_centers, n_centers)
        remaining = states.remaining[numbers].astype(np.float32)
        hands = np.tile(IDENTITY, (len(numbers), 1))
        if rng is not None:
            hands, remaining = self._augment(remaining, rng)
        goals = compose(invert_pose(hands), states.goals[numbers].astype(np.float64))
        points = _gather_ragged(states.points, self._first_points, numbers).astype(np.float32)
        centers = _gather_ragged(states.centers, self._first_centers, numbers)
        n_neighbors = _gather_ragged(states.n_neighbors, self._first_centers, numbers)
        n_center_neighbors = _gather_ragged(states.n_center_neighbors, self._first_centers, numbers)
        neighbors = _gather_ragged(states.neighbors, self._first_neighbors, numbers)
        neighbors, n_neighbors = _truncate_groups(neighbors, n_neighbors, self._config.max_neighbors)
        center_neighbors = _gather_ragged(states.center_neighbors, self._first_center_neighbors, numbers)
        return ImitationBatch(
            points=torch.from_numpy(_transform_to_hands(hands, points, n_points)),
            centers=torch.from_numpy(centers + point_offsets),
            neighbors=torch.from_numpy(neighbors + np.repeat(point_offsets, n_neighbors)),
            n_neighbors=torch.from_numpy(n_neighbors.astype(np.int64)),
            center_neighbors=torch.from_numpy(center_neighbors + np.repeat(center_offsets, n_center_neighbors)),
            n_center_neighbors=torch.from_numpy(n_center_neighbors.astype(np.int64)),
            n_centers=torch.from_numpy(n_centers.astype(np.int64)),
            remaining=torch.from_numpy(remaining),
            steps=torch.from_numpy(self._compute_steps(goals, remaining)),
            goals=torch.from_numpy(goals.astype(np.float32)),
        )

    def _compute_steps(
        self, goals: npt.NDArray[np.float64], remaining: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        hands = np.tile(IDENTITY, (len(goals), 1))
        return compute_approach_steps(hands, goals, remaining.astype(np.float64), self._approach).astype(np.float32)

    def _augment(
        self, remaining: npt.NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
        """Return random poses (B, 7) of the hands in their stored frames, and changed counters (B,)."""
        config, count = self._config, len(remaining)
        quaternions = Rotation.from_rotvec(rng.normal(0.0, config.rotation_std, (count, 3))).as_quat()
        hands = np.concatenate([rng.normal(0.0, config.position_std, (count, 3)), quaternions], axis=1)
        changed = remaining + rng.integers(-config.counter_range, config.counter_range + 1, count)
        return hands, np.clip(changed, 1, config.max_remaining).astype(np.float32)
