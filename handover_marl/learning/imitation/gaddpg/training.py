"""Training of GA-DDPG's network: augmented batches of imitation states, losses and learner.

States are augmented by random changes of the pose of the robot's hand. As in GA-DDPG, a loss is the mean L1 distance
between six points of the gripper at two poses.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from handover_marl.geometry.poses import IDENTITY, compose, inverse_transform_points, invert_pose, transform_points
from handover_marl.learning.imitation.gaddpg.expert import EXPERT_SPARE_STEPS
from handover_marl.learning.imitation.run import Batches, ImitationLearner
from handover_marl.learning.networks.approach_field import compute_approach_steps
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
from handover_marl.receivers.gaddpg import GRIPPER_POINTS

# Standard deviations of the augmentation, a change of the hand's pose: displacement along each axis (m) and rotation
# about each axis (rad). The point cloud still shows what was visible from the stored pose.
_POSITION_STD, _ROTATION_STD = 0.012, 0.05
# Largest random change of the number of remaining decisions, which is an input of the network, and the largest number
# after the change.
_COUNTER_RANGE, _MAX_REMAINING = 6, 20
# Largest learning rate of the point cloud encoder; `learning_rate` is that of the layers after it.
_ENCODER_RATE = 1e-3
# Weight of the loss of the actions relative to the loss of the predicted grasps, and distance from the hand to the
# target grasp at which the latter has half its weight (m).
_ACTION_WEIGHT, _HALF_DISTANCE = 0.2, 0.1
# Largest number of held-out states on which losses are computed.
_N_HELD_OUT = 256
_GRIPPER_POINTS = torch.tensor(GRIPPER_POINTS.T)
# The loss of actions uses points rotated by pi/2 against the Panda's fingers, as the original does.
_QUARTER_TURNED_POINTS = _GRIPPER_POINTS[:, [1, 0, 2]]
# A grasp rotated by pi about the hand's z axis is equivalent.
_HALF_TURNED_POINTS = _GRIPPER_POINTS * torch.tensor([-1.0, -1.0, 1.0])


class ImitationBatch(NamedTuple):
    """Tensors of B imitation states in the frames of the Panda's hand link.

    Attributes:
        clouds: (B, 4, 1024) inputs of the network: xyz of the points (m) and a zero.
        remaining: (B,) numbers of decisions that remain in the approach.
        steps: (B, 6) motions of the hand by the expert's next decision: translation (m) and extrinsic xyz Euler angles
            (rad).
        goals: (B, 7) poses of the hand link at the grasps: xyz (m) and quaternion xyzw.
    """

    clouds: Tensor
    remaining: Tensor
    steps: Tensor
    goals: Tensor


class ImitationBatches(Batches):
    """Data set of `ImitationStates` from which batches are selected."""

    def sample(self, count: int, rng: np.random.Generator) -> ImitationBatch:
        """Draw a batch of `count` states with replacement; augment the hand poses and the remaining decisions."""
        return self.select(rng.integers(len(self), size=count), rng)

    def select(self, numbers: npt.NDArray[np.int_], rng: np.random.Generator | None) -> ImitationBatch:
        """Return a batch of the states with the indices `numbers` (B,), augmented unless `rng` is None."""
        points, goals, remaining = (array[numbers].astype(np.float64) for array in self._samples)
        count, present = len(numbers), np.tile(IDENTITY, (len(numbers), 1))
        if rng is not None:
            rotations = Rotation.from_rotvec(rng.normal(0.0, _ROTATION_STD, (count, 3))).as_quat()
            hands = np.concatenate([rng.normal(0.0, _POSITION_STD, (count, 3)), rotations], axis=1)
            points, goals = inverse_transform_points(hands[:, None], points), compose(invert_pose(hands), goals)
            remaining += rng.integers(-_COUNTER_RANGE, _COUNTER_RANGE + 1, count)
            remaining = np.clip(remaining, 1, _MAX_REMAINING)
        steps = compute_approach_steps(present, goals, remaining, EXPERT_SPARE_STEPS)
        clouds = np.pad(points.swapaxes(1, 2), ((0, 0), (0, 1), (0, 0)))
        return ImitationBatch(*(torch.from_numpy(a.astype(np.float32)) for a in (clouds, remaining, steps, goals)))


def compute_action_losses(steps: Tensor, targets: Tensor) -> Tensor:
    """Return GA-DDPG's losses (B,) in m of predicted motions of the Panda's hand link.

    A loss is the mean L1 distance between six gripper points after the predicted and after the target motion. Motions,
    predicted `steps` (B, 6) and `targets` (B, 6), consist of a translation (m) and extrinsic xyz Euler angles (rad) in
    the hand link's frame.
    """
    points = _QUARTER_TURNED_POINTS.to(steps.device)
    return _compute_mean_distances(_poses_from_steps(steps), points, _poses_from_steps(targets), points)


def compute_goal_losses(goals: Tensor, targets: Tensor) -> Tensor:
    """Return GA-DDPG's losses (B,) in m of predicted grasps.

    A loss is the mean L1 distance between six gripper points at the predicted and at the target grasp. A rotation of
    the target by pi about the hand link's z axis does not change it.

    Args:
        goals: (B, 7) predicted poses of the hand link: quaternion wxyz, then xyz (m).
        targets: (B, 7) target poses of the hand link: xyz (m), then quaternion xyzw.
    """
    points, turned = _GRIPPER_POINTS.to(goals.device), _HALF_TURNED_POINTS.to(goals.device)
    poses = goals[:, [4, 5, 6, 1, 2, 3, 0]]
    return torch.minimum(*(_compute_mean_distances(poses, points, targets, either) for either in (points, turned)))


def _compute_mean_distances(poses: Tensor, points: Tensor, others: Tensor, other_points: Tensor) -> Tensor:
    """Return mean L1 distances (B,) of `points` (6, 3) at `poses` (B, 7) from `other_points` (6, 3) at `others`."""
    offsets = transform_points(poses[:, None], points) - transform_points(others[:, None], other_points)
    distances: Tensor = offsets.abs().sum(dim=-1).mean(dim=-1)
    return distances


def _poses_from_steps(steps: Tensor) -> Tensor:
    """Return poses (B, 7), xyz and quaternion xyzw, of translations and extrinsic xyz Euler angles, (B, 6)."""
    (sa, sb, sc), (ca, cb, cc) = ((function(0.5 * steps[:, 3:])).unbind(1) for function in (torch.sin, torch.cos))
    x, y = sa * cb * cc - ca * sb * sc, ca * sb * cc + sa * cb * sc
    z, w = ca * cb * sc - sa * sb * cc, ca * cb * cc + sa * sb * sc
    return torch.cat([steps[:, :3], torch.stack([x, y, z, w], dim=1)], dim=1)


class GaddpgLearner(ImitationLearner[GaddpgNetwork, ImitationBatch]):
    """Trainer of the network of the receiver `gaddpg`, see `ImitationLearner`."""

    learning_rate, final_share, warmup, epsilon = 6e-4, 0.01, 100, 1e-5
    max_gradient_norm, averaging = 1.0, 0.998

    def list_parameter_groups(self, network: GaddpgNetwork) -> list[tuple[Iterable[nn.Parameter], float]]:
        """Return the parameters of the encoder and of the head, each with its largest learning rate."""
        return [(network.features.parameters(), _ENCODER_RATE), (network.policy.parameters(), self.learning_rate)]

    def evaluate(self, held_out: ImitationBatches) -> dict[str, float]:
        """Return the losses "action" and "goal" (m) of the network with averaged weights on held-out states."""
        some = np.random.default_rng(0).permutation(len(held_out))[:_N_HELD_OUT]
        with torch.no_grad():
            _, losses = self.compute_losses(self.averaged_network, held_out.select(some, None))
        return {name: float(value) for name, value in losses.items()}

    def compute_losses(self, network: GaddpgNetwork, batch: ImitationBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss to minimize, and its terms "action" (error of motions) and "goal" (error of grasps) in m."""
        clouds, remaining, steps, goals = (part.to(self._device) for part in batch)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.use_bfloat16):
            output = network(clouds, remaining)
        action = compute_action_losses(output.action.float(), steps).mean()
        losses = compute_goal_losses(output.goal.float(), goals)
        # Distant goals are predicted again from nearer by.
        weights = _HALF_DISTANCE / (_HALF_DISTANCE + goals[:, :3].norm(dim=1))
        return _ACTION_WEIGHT * action + (weights * losses).mean(), {"action": action, "goal": losses.mean()}
