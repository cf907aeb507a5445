"""Training of GA-DDPG's network: augmented batches of imitation states, losses and learner.

States are augmented by random changes of the pose of the robot's hand. PointNet++ groups points around sampled centers.
The groups depend only on the distances between points, so an augmented cloud has the groups of the stored cloud. Each
point counts once in a group; the deployed network repeats points to fill groups, which does not change its output. As
in GA-DDPG, a loss is the mean L1 distance between six points of the gripper at two poses.
"""

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as func
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from handover_marl.geometry.poses import IDENTITY, compose, invert_pose
from handover_marl.geometry.rotations import matrices_from_quaternions
from handover_marl.learning.imitation.gaddpg.data_generation import ImitationStates
from handover_marl.learning.imitation.gaddpg.expert import EXPERT_SPARE_STEPS
from handover_marl.learning.imitation.learner import ImitationLearner
from handover_marl.learning.networks.approach_field import compute_approach_steps
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
from handover_marl.learning.networks.point_encoders import GADDPG_GROUPINGS, PointNetPlusPlus, sample_farthest_points
from handover_marl.receivers.gaddpg import GRIPPER_POINTS


class ImitationBatch(NamedTuple):
    """Tensors of B imitation states with N points and M centers of groups.

    A hand is the Panda's hand link in one of the states.

    Attributes:
        points: (B, N, 3) points in the hands' frames (m).
        centers: (B, M) indices of the points that are centers of groups.
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
    """Draw poses (B, 7) of hands in their stored frames, and changed numbers of remaining decisions (B,)."""
    count = len(remaining)
    quaternions = Rotation.from_rotvec(rng.normal(0.0, _ROTATION_STD, (count, 3))).as_quat()
    hands = np.concatenate([rng.normal(0.0, _POSITION_STD, (count, 3)), quaternions], axis=1)
    changed = remaining + rng.integers(-_COUNTER_RANGE, _COUNTER_RANGE + 1, count)
    return hands, np.clip(changed, 1, _MAX_REMAINING).astype(np.float32)


def _group_points(points: Tensor, n_points: Tensor, max_neighbors: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Group the first `n_points` (B,) points of clouds (B, N, 3) around centers; drop neighbors above `max_neighbors`.

    Returns `centers`, `is_center`, `neighbors` and `center_neighbors` of `ImitationBatch`.
    """
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


def encode_batch(encoder: PointNetPlusPlus, batch: ImitationBatch) -> Tensor:
    """Encode the B point clouds of a batch, with its groups of points, as vectors (B, 512).

    The encoder's present mode, training or evaluation, determines the statistics of batch normalization.
    """
    first, second, last = encoder.stages
    centers = batch.points.gather(1, batch.centers[..., None].expand(-1, -1, 3))
    cloud, center, point = batch.neighbors.nonzero(as_tuple=True)
    points = batch.points[cloud, point]
    channels = points.new_zeros((len(points), 1))
    rows = torch.cat([points - centers[cloud, center], points, channels], dim=1)
    groups = _max_pool_rows(_apply_layers(first, rows), batch.neighbors.sum(dim=-1)[batch.is_center])
    features = groups.new_zeros((*batch.centers.shape, groups.shape[1]))
    features[batch.is_center] = groups
    cloud, center, other = batch.center_neighbors.nonzero(as_tuple=True)
    rows = torch.cat([centers[cloud, other] - centers[cloud, center], features[cloud, other]], dim=1)
    wide = _max_pool_rows(_apply_layers(second, rows), batch.center_neighbors.sum(dim=-1)[batch.is_center])
    rows = torch.cat([centers[batch.is_center], wide], dim=1)
    whole = _max_pool_rows(_apply_layers(last, rows), batch.is_center.sum(dim=-1))
    vector: Tensor = encoder.dense(whole)
    return vector.float()


def _apply_layers(stage: Any, rows: Tensor) -> Tensor:
    """Apply a stage's convolutions of width 1, with batch normalization, to rows (n, c)."""
    for convolution, norm in itertools.pairwise(stage.mlps[0]):
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            rows = func.linear(rows, convolution.weight[:, :, 0, 0]).float()
            rows = func.relu(norm(rows[:, :, None, None])[:, :, 0, 0])
    return rows


def _max_pool_rows(rows: Tensor, counts: Tensor) -> Tensor:
    """Return the maxima (g, c) of consecutive groups of rows (n, c) with given sizes (g,)."""
    return torch.segment_reduce(rows.float(), "max", lengths=counts, unsafe=True)


_GRIPPER_POINTS = torch.tensor(GRIPPER_POINTS.T, dtype=torch.float32)
# The loss of actions uses points rotated by pi/2 against the Panda's fingers, as the original does.
_QUARTER_TURNED_POINTS = _GRIPPER_POINTS[:, [1, 0, 2]]
# A grasp rotated by pi about the hand's z axis is equivalent.
_HALF_TURNED_POINTS = _GRIPPER_POINTS * torch.tensor([-1.0, -1.0, 1.0])


def compute_action_losses(steps: Tensor, targets: Tensor) -> Tensor:
    """Return GA-DDPG's losses (B,) in m of predicted motions of the Panda's hand link.

    A loss is the mean L1 distance between six gripper points after the predicted and after the target motion.

    Args:
        steps: (B, 6) predicted motions in the hand link's frame: translation (m) and extrinsic xyz Euler angles (rad).
        targets: (B, 6) target motions, in the same form.
    """
    points = _QUARTER_TURNED_POINTS.to(steps.device)
    return _mean_l1_distance(
        _transform_points(points, _rotations_from_euler(steps[:, 3:]), steps[:, :3]),
        _transform_points(points, _rotations_from_euler(targets[:, 3:]), targets[:, :3]),
    )


def compute_goal_losses(goals: Tensor, targets: Tensor) -> Tensor:
    """Return GA-DDPG's losses (B,) in m of predicted grasps.

    A loss is the mean L1 distance between six gripper points at the predicted and at the target grasp. A rotation of
    the target by pi about the hand link's z axis does not change it.

    Args:
        goals: (B, 7) predicted poses of the hand link: quaternion wxyz, then xyz (m).
        targets: (B, 7) target poses of the hand link: xyz (m), then quaternion xyzw.
    """
    points, turned = _GRIPPER_POINTS.to(goals.device), _HALF_TURNED_POINTS.to(goals.device)
    found = _transform_points(points, matrices_from_quaternions(goals[:, [1, 2, 3, 0]]).float(), goals[:, 4:])
    rotations = matrices_from_quaternions(targets[:, 3:]).float()
    distances = [
        _mean_l1_distance(found, _transform_points(either, rotations, targets[:, :3])) for either in (points, turned)
    ]
    return torch.minimum(*distances)


def _mean_l1_distance(points: Tensor, others: Tensor) -> Tensor:
    return (points - others).abs().sum(dim=-1).mean(dim=-1)


def _transform_points(points: Tensor, rotations: Tensor, translations: Tensor) -> Tensor:
    """Return points (6, 3) rotated by (B, 3, 3) and translated by (B, 3), as (B, 6, 3)."""
    return points @ rotations.transpose(1, 2) + translations[:, None]


def _rotations_from_euler(angles: Tensor) -> Tensor:
    """Return rotation matrices (B, 3, 3) of extrinsic xyz Euler angles (B, 3)."""
    (sa, sb, sc), (ca, cb, cc) = angles.sin().unbind(dim=1), angles.cos().unbind(dim=1)
    rows = [
        torch.stack([cb * cc, sb * sa * cc - ca * sc, sb * ca * cc + sa * sc], dim=1),
        torch.stack([cb * sc, sb * sa * sc + ca * cc, sb * ca * sc - sa * cc], dim=1),
        torch.stack([-sb, cb * sa, cb * ca], dim=1),
    ]
    return torch.stack(rows, dim=1)


# Largest learning rate of the point cloud encoder; `learning_rate` is that of the layers after it.
_ENCODER_RATE = 1e-3
# Weight of the loss of the actions relative to the loss of the predicted grasps, and distance from the hand to the
# target grasp at which the latter has half its weight (m).
_ACTION_WEIGHT, _HALF_DISTANCE = 0.2, 0.1
# Largest number of held-out states on which losses are computed.
_N_HELD_OUT = 256


class GaddpgLearner(ImitationLearner[GaddpgNetwork, ImitationBatch]):
    """Trainer of GA-DDPG's network, see `ImitationLearner`."""

    learning_rate, final_share, warmup, epsilon = 6e-4, 0.01, 100, 1e-5
    max_gradient_norm, averaging = 1.0, 0.998

    def list_parameter_groups(self, network: GaddpgNetwork) -> list[tuple[Iterable[nn.Parameter], float]]:
        """Return the parameters of the encoder and of the head, each with its largest learning rate."""
        return [(network.features.parameters(), _ENCODER_RATE), (network.policy.parameters(), self.learning_rate)]

    def evaluate(self, held_out: ImitationBatches) -> dict[str, float]:
        """Return the losses "action" and "goal" (m) of the network with averaged weights on held-out states."""
        some = np.random.default_rng(0).permutation(len(held_out))[:_N_HELD_OUT]
        with torch.no_grad():
            _, losses = self.compute_losses(self.averaged, held_out.select(some, None))
        return {name: float(value) for name, value in losses.items()}

    def compute_losses(self, network: GaddpgNetwork, batch: ImitationBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss to minimize, and its terms "action" (error of motions) and "goal" (error of grasps) in m."""
        moved = batch.to(self._device)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.use_bfloat16):
            output = network.policy(encode_batch(network.features, moved), moved.remaining)
        action = compute_action_losses(output.action.float(), moved.steps).mean()
        goals = compute_goal_losses(output.goal.float(), moved.goals)
        # Distant goals are predicted again from nearer by.
        weights = _HALF_DISTANCE / (_HALF_DISTANCE + moved.goals[:, :3].norm(dim=1))
        return _ACTION_WEIGHT * action + (weights * goals).mean(), {"action": action, "goal": goals.mean()}
