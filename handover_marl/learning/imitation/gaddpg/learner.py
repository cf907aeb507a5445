"""Training of GA-DDPG's network: losses, optimizer, learning rates and averaged weights.

As in GA-DDPG, a loss is the mean L1 distance between six points of the gripper at two poses.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.learning.imitation.gaddpg.batches import ImitationBatch
from handover_marl.learning.networks.approach_field import ApproachFieldConfig
from handover_marl.learning.networks.gaddpg_network import ActorOutput, GaddpgNetwork
from handover_marl.learning.networks.point_encoders import PointNetPlusPlus, SetAbstraction


def evaluate_network(network: GaddpgNetwork, batch: ImitationBatch) -> ActorOutput:
    """Return the outputs of GA-DDPG's network for a batch of states, in the network's present mode.

    The mode (training or evaluation) determines the statistics of batch normalization.
    """
    output: ActorOutput = network.policy(_encode(network.features, batch), batch.remaining)
    return output


def _encode(encoder: PointNetPlusPlus, batch: ImitationBatch) -> Tensor:
    """Encode a batch as vectors (B, 512)."""
    first, second, last = (_shared_layers(stage) for stage in encoder.stages)
    points, centers = batch.points[batch.neighbors], batch.points[batch.centers]
    channels = points.new_zeros((len(points), encoder.n_channels - 3))
    relative = points - centers.repeat_interleave(batch.n_neighbors, dim=0)
    rows = torch.cat([relative, points, channels], dim=1)
    groups = _max_pool_rows(_apply_layers(first, rows), batch.n_neighbors)
    relative = centers[batch.center_neighbors] - centers.repeat_interleave(batch.n_center_neighbors, dim=0)
    rows = torch.cat([relative, groups[batch.center_neighbors]], dim=1)
    wide = _max_pool_rows(_apply_layers(second, rows), batch.n_center_neighbors)
    whole = _max_pool_rows(_apply_layers(last, torch.cat([centers, wide], dim=1)), batch.n_centers)
    vector: Tensor = encoder.dense(whole)
    return vector.float()


def _shared_layers(stage: nn.Module) -> nn.Sequential:
    layers = stage.mlps[0] if isinstance(stage, SetAbstraction) else stage
    if not isinstance(layers, nn.Sequential):
        raise TypeError(f"stage must be a SetAbstraction, got {type(stage).__name__}")
    return layers


def _apply_layers(layers: nn.Sequential, rows: Tensor) -> Tensor:
    """Apply convolutions of width 1 with batch normalization to rows (n, c)."""
    for convolution, norm in itertools.pairwise(layers):
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            rows = func.linear(rows, convolution.weight[:, :, 0, 0])
            rows = func.relu(_normalize_rows(norm, rows.float()))
    return rows


def _normalize_rows(norm: nn.BatchNorm2d, rows: Tensor) -> Tensor:
    momentum = 0.1 if norm.momentum is None else norm.momentum
    return func.batch_norm(
        rows, norm.running_mean, norm.running_var, norm.weight, norm.bias, norm.training, momentum, norm.eps
    )


def _max_pool_rows(rows: Tensor, counts: Tensor) -> Tensor:
    """Return the maxima (g, c) of consecutive groups of rows (n, c) with given sizes (g,)."""
    return torch.segment_reduce(rows.float(), "max", lengths=counts, unsafe=True)


# The wrist twice, and two points on each finger, in the hand link's frame (m).
_GRIPPER_POINTS = torch.tensor(
    [
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.053, 0.075],
        [0.0, -0.053, 0.075],
        [0.0, 0.053, 0.105],
        [0.0, -0.053, 0.105],
    ]
)
# The loss of actions uses points rotated by pi/2 against the Panda's fingers, as the original does.
_QUARTER_TURNED_POINTS = _GRIPPER_POINTS[:, [1, 0, 2]]
# A grasp rotated by pi about the hand's z axis is equivalent.
_HALF_TURNED_POINTS = _GRIPPER_POINTS * torch.tensor([-1.0, -1.0, 1.0])


def compute_action_losses(steps: Tensor, targets: Tensor) -> Tensor:
    """Return GA-DDPG's loss (B,) of predicted hand motions: mean distances of gripper points (m).

    Six points of the gripper are moved by the predicted and by the target motion; the loss is the
    mean L1 distance between both positions of a point.

    Args:
        steps: (B, 6) predicted motions: translation (m) and extrinsic xyz Euler angles (rad).
        targets: (B, 6) target motions, in the same form.
    """
    points = _QUARTER_TURNED_POINTS.to(steps.device)
    return _mean_l1_distance(
        _transform_points(points, _rotations_from_euler(steps[:, 3:]), steps[:, :3]),
        _transform_points(points, _rotations_from_euler(targets[:, 3:]), targets[:, :3]),
    )


def compute_goal_losses(goals: Tensor, targets: Tensor) -> Tensor:
    """Return GA-DDPG's loss (B,) of predicted grasps: mean distances of gripper points (m).

    The loss is the mean L1 distance between the positions of six points of the gripper at the
    predicted and at the target grasp. A rotation of the target by pi about the hand's z axis does
    not change the loss.

    Args:
        goals: (B, 7) predicted poses of the hand link: quaternion wxyz, then xyz (m).
        targets: (B, 7) target poses of the hand link: xyz (m), then quaternion xyzw.
    """
    points, turned = _GRIPPER_POINTS.to(goals.device), _HALF_TURNED_POINTS.to(goals.device)
    found = _transform_points(points, _rotations_from_quaternions(goals[:, :4]), goals[:, 4:])
    rotations = _rotations_from_quaternions(targets[:, [6, 3, 4, 5]])
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


def _rotations_from_quaternions(quaternions: Tensor) -> Tensor:
    """Return rotation matrices (B, 3, 3) of unit quaternions (B, 4) wxyz."""
    w, x, y, z = quaternions.unbind(dim=1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return torch.stack(rows, dim=1)


@dataclass(frozen=True)
class GaddpgLearnerConfig:
    """Hyperparameters of the training of GA-DDPG's network.

    Attributes:
        encoder_rate: Largest learning rate of the point cloud encoder.
        head_rate: Largest learning rate of the layers after the encoder.
        final_share: Learning rates at the end of their cosine decay, as fraction of the largest.
        warmup: Number of updates at the start in which the learning rates rise.
        decay: Weight decay.
        action: Weight of the loss of the actions relative to the loss of the predicted grasps.
        half_distance: Distance from the hand to the target grasp at which the loss of the predicted
            grasp has half its weight (m).
        clip: Largest norm of the gradient; longer gradients are scaled down.
        averaging: Decay of the exponential average of the weights.
        use_bfloat16: Whether matrix products are computed in bfloat16.
    """

    encoder_rate: float = 1e-3
    head_rate: float = 6e-4
    final_share: float = 0.01
    warmup: int = 100
    decay: float = 1e-4
    action: float = 0.2
    half_distance: float = 0.1
    clip: float = 1.0
    averaging: float = 0.998
    use_bfloat16: bool = True


class GaddpgLearner:
    """Trainer of GA-DDPG's network, with optimizer and exponentially averaged weights.

    Args:
        updates: Number of updates of the whole training, over which the learning rates decay.
        seed: Seed of the initial weights.
        device: Device to train on.
        config: Hyperparameters.
        approach: Rule by which the network approaches the grasps that it predicts.
        max_steps: Number of decisions of an approach; None leaves it to the receiver.

    Attributes:
        done: Number of updates so far.
        averaged: Network with the averaged weights, for use after training.
    """

    def __init__(
        self,
        updates: int,
        seed: int,
        device: torch.device,
        config: GaddpgLearnerConfig,
        approach: ApproachFieldConfig,
        max_steps: int | None = None,
    ) -> None:
        torch.manual_seed(seed)
        self._config, self._updates, self._device = config, updates, device
        self._network = GaddpgNetwork(approach, max_steps).to(device)
        self.averaged = GaddpgNetwork(approach, max_steps).to(device).eval()
        self.averaged.load_state_dict(self._network.state_dict())
        groups = [
            {"params": list(self._network.features.parameters()), "rate": config.encoder_rate},
            {"params": list(self._network.policy.parameters()), "rate": config.head_rate},
        ]
        self._optimizer = torch.optim.AdamW(groups, lr=config.encoder_rate, weight_decay=config.decay, eps=1e-5)
        self.done = 0

    def update(self, batch: ImitationBatch) -> dict[str, float]:
        """Update the network on a batch of states; return the losses "action" and "goal" (m)."""
        self._network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = group["rate"] * self._rate_share()
        action, goal, weighted_goal = self._compute_losses(self._network, batch)
        loss = self._config.action * action + weighted_goal
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), self._config.clip)
        self._optimizer.step()
        self.done += 1
        self._update_average()
        return {"action": float(action.detach()), "goal": float(goal.detach())}

    def evaluate(self, batch: ImitationBatch) -> dict[str, float]:
        """Return the losses "action" and "goal" of the averaged network on a batch of states (m)."""
        with torch.no_grad():
            action, goal, _ = self._compute_losses(self.averaged, batch)
        return {"action": float(action.detach()), "goal": float(goal.detach())}

    def get_state(self) -> dict[str, Any]:
        """Return weights, optimizer state and progress for a checkpoint."""
        return {
            "done": self.done,
            "network": self._network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore weights, optimizer state and progress from a checkpoint."""
        self._network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.done = int(state["done"])

    def _compute_losses(self, network: GaddpgNetwork, batch: ImitationBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean losses of actions, of goals, and of goals weighted by their distance."""
        moved = batch.to(self._device)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._config.use_bfloat16):
            output = evaluate_network(network, moved)
        action = compute_action_losses(output.action.float(), moved.steps).mean()
        goals = compute_goal_losses(output.goal.float(), moved.goals)
        # Distant goals are predicted again from nearer by.
        distance = self._config.half_distance
        weights = distance / (distance + moved.goals[:, :3].norm(dim=1))
        return action, goals.mean(), (weights * goals).mean()

    def _rate_share(self) -> float:
        """Return the present learning rates as fraction of the largest ones."""
        config = self._config
        rise = min(1.0, (self.done + 1) / max(1, config.warmup))
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.done / max(1, self._updates))))
        return rise * (config.final_share + (1.0 - config.final_share) * fall)

    def _update_average(self) -> None:
        # Averages over few updates at first, so that the initial weights are soon forgotten.
        decay = min(self._config.averaging, (1.0 + self.done) / (10.0 + self.done))
        with torch.no_grad():
            current, averaged = self._network.state_dict(), self.averaged.state_dict()
            for name, value in averaged.items():
                if value.is_floating_point():
                    value.lerp_(current[name], 1.0 - decay)
                else:
                    value.copy_(current[name])
