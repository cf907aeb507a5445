"""Training and metrics of the grasp network. The module needs the extra `train`."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from handover_marl.learning.imitation.vision.views import GraspViews
from handover_marl.learning.networks.grasp_losses import (
    GraspLosses,
    GraspTargets,
    compute_grasp_distances,
    compute_grasp_losses,
    grasp_targets_from_poses,
)
from handover_marl.learning.networks.grasp_network import GraspNetwork, GraspOutputs, PointCloudBatch


@dataclass(frozen=True)
class GraspTrainingConfig:
    """Hyperparameters of the training of the grasp network.

    Attributes:
        batch_size: Number of views per gradient update.
        n_centers: Number of points per view at which grasps are predicted.
        learning_rate: Initial learning rate of AdamW; it decays to 0 as half a cosine.
        weight_decay: Weight decay of AdamW.
        grasp_loss_weight: Weight of the loss of the predicted grasps (1/m).
        quality_loss_weight: Weight of the loss of the grasps' predicted quality.
        center_loss_weight: Weight of the loss of the object's predicted center (1/m).
        motion_loss_weight: Weight of the loss of the object's predicted displacement (1/m).
        roll_std: Standard deviation of the random rotation of each view about the line of sight (rad).
        point_noise_std: Standard deviation of the noise that is added to the coordinates of points (m).
        max_gradient_norm: Largest norm of the gradient; longer gradients are scaled down.
    """

    batch_size: int = 64
    n_centers: int = 48
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    grasp_loss_weight: float = 10.0
    quality_loss_weight: float = 2.0
    center_loss_weight: float = 2.0
    motion_loss_weight: float = 1.0
    roll_std: float = 0.6
    point_noise_std: float = 0.001
    max_gradient_norm: float = 5.0


@dataclass(frozen=True)
class GraspMetrics:
    """Accuracy of predicted grasps on held-out views.

    Distances are computed by
    `handover_marl.learning.networks.grasp_losses.compute_grasp_distances`.

    Attributes:
        views: Number of views with at least one good grasp.
        within_1cm: Share of these views whose best predicted grasp is within 1 cm of a good one.
        within_2cm: Share of these views whose best predicted grasp is within 2 cm of a good one.
        median_distance: Median distance of the best predicted grasp from a good one (m).
        grasp_loss: Loss of the grasps (m).
        quality_loss: Loss of the grasps' quality.
    """

    views: int
    within_1cm: float
    within_2cm: float
    median_distance: float
    grasp_loss: float
    quality_loss: float


class LabelledClouds(NamedTuple):
    """Batch of B point clouds with training targets of the grasp network.

    Attributes:
        clouds: Inputs of the network.
        targets: Good grasps.
        object_center: (B, 3) centers of the objects (m).
        object_motion: (B, 3) displacements of the objects within the prediction time (m).
    """

    clouds: PointCloudBatch
    targets: GraspTargets
    object_center: Tensor
    object_motion: Tensor

    def compute_losses(self, outputs: GraspOutputs) -> GraspLosses:
        """Compute the losses of the grasp network's outputs on this batch."""
        centers = self.clouds.get_center_points()
        return compute_grasp_losses(outputs, centers, self.targets, self.object_center, self.object_motion)


class ViewBatches:
    """Data set of rendered views as tensors, from which batches are selected.

    Args:
        views: Arrays of the views.
        device: Device of the tensors.
    """

    def __init__(self, views: GraspViews, device: torch.device) -> None:
        self._tensors = [torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in views]

    def __len__(self) -> int:
        return len(self._tensors[0])

    def select(self, numbers: Tensor, centers: int, generator: torch.Generator) -> LabelledClouds:
        """Return a batch of the views with given indices, each with random centers.

        Args:
            numbers: (B,) indices of the views.
            centers: Number of object points per view at which grasps are predicted.
            generator: Generator that draws the centers.
        """
        parts = [tensor[numbers.to(tensor.device)].float() for tensor in self._tensors]
        objects, hands, n_hands, grasps, quality, object_center, velocity, motion = parts
        indices = torch.rand(objects.shape[:2], generator=generator).argsort(dim=1)[:, :centers].to(objects.device)
        mask = torch.arange(hands.shape[1], device=hands.device) < n_hands[:, None]
        clouds = PointCloudBatch(objects, hands, mask, indices, velocity)
        return LabelledClouds(clouds, grasp_targets_from_poses(grasps, quality), object_center, motion)


class GraspTrainer:
    """Trainer of the grasp network; reproducible for a seed, a device and a number of threads.

    Args:
        network: Network to train.
        config: Hyperparameters.
        updates: Number of gradient updates, for the decay of the learning rate.
        seed: Seed of all random numbers.
        device: Device to train on.

    Attributes:
        done: Number of updates so far.
    """

    def __init__(
        self, network: GraspNetwork, config: GraspTrainingConfig, updates: int, seed: int, device: torch.device
    ) -> None:
        self.network, self.config, self.device = network.to(device), config, device
        self.done, self._updates = 0, updates
        self._optimizer = torch.optim.AdamW(
            network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        self._generator = torch.Generator().manual_seed(seed)

    def update(self, views: ViewBatches) -> GraspLosses:
        """Update the network on a random batch of views; return its losses before the update."""
        config = self.config
        for group in self._optimizer.param_groups:
            group["lr"] = 0.5 * config.learning_rate * (1.0 + math.cos(math.pi * min(1.0, self.done / self._updates)))
        numbers = torch.randint(len(views), (config.batch_size,), generator=self._generator)
        batch = self._augment(views.select(numbers, config.n_centers, self._generator))
        self.network.train()
        # Half precision suffices for training and takes a third of the time.
        with torch.autocast(self.device.type, torch.bfloat16):
            outputs = self.network(batch.clouds)
        losses = batch.compute_losses(outputs)
        total = config.grasp_loss_weight * losses.grasp + config.quality_loss_weight * losses.quality
        total = total + config.center_loss_weight * losses.object_center
        total = total + config.motion_loss_weight * losses.object_motion
        self._optimizer.zero_grad()
        torch.autograd.backward(total)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.max_gradient_norm)
        self._optimizer.step()
        self.done += 1
        return GraspLosses(*(value.detach() for value in losses))

    def get_state(self) -> dict[str, Any]:
        """Return weights, optimizer state and progress for a checkpoint."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "draw": self._generator.get_state(),
            "done": self.done,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore weights, optimizer state and progress from a checkpoint."""
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["draw"])
        self.done = int(state["done"])

    def _augment(self, batch: LabelledClouds) -> LabelledClouds:
        """Return the batch rotated randomly about the line of sight, with noise on points."""
        config, clouds, targets = self.config, batch.clouds, batch.targets
        angle = config.roll_std * torch.randn(len(clouds.object_points), generator=self._generator).to(self.device)
        cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        rows = ([cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1.0])
        rotation = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        objects, hands = (
            cloud @ rotation.mT
            + config.point_noise_std * torch.randn(cloud.shape, generator=self._generator).to(self.device)
            for cloud in (clouds.object_points, clouds.hand_points)
        )
        velocity, center, motion = (
            torch.einsum("bij,bj->bi", rotation, vector)
            for vector in (clouds.object_velocity, batch.object_center, batch.object_motion)
        )
        return LabelledClouds(
            clouds._replace(object_points=objects, hand_points=hands, object_velocity=velocity),
            GraspTargets(targets.positions @ rotation.mT, rotation[:, None] @ targets.rotations, targets.quality),
            center,
            motion,
        )


def compute_grasp_metrics(
    network: GraspNetwork, views: ViewBatches, config: GraspTrainingConfig, min_quality: float = 0.3
) -> GraspMetrics:
    """Compute the accuracy of a grasp network's predictions on held-out views.

    Args:
        network: Trained network.
        views: Held-out views.
        config: Hyperparameters, for the sizes of batches.
        min_quality: Quality from which a grasp counts as good.
    """
    network.eval()
    distances, losses = [], []
    generator = torch.Generator().manual_seed(0)
    with torch.inference_mode():
        for numbers in torch.split(torch.arange(len(views)), 4 * config.batch_size):
            batch = views.select(numbers, 2 * config.n_centers, generator)
            outputs = network(batch.clouds)
            losses.append(torch.stack([*batch.compute_losses(outputs)]) * len(numbers))
            distances.append(_compute_best_distances(outputs, batch.targets, min_quality))
    best = torch.cat(distances)
    best = best[torch.isfinite(best)]
    means = torch.stack(losses).sum(dim=0) / max(1, len(views))
    if not len(best):
        return GraspMetrics(0, math.nan, math.nan, math.nan, float(means[0]), float(means[1]))
    shares = [float((best < limit).float().mean()) for limit in (0.01, 0.02)]
    return GraspMetrics(len(best), shares[0], shares[1], float(best.median()), float(means[0]), float(means[1]))


def _compute_best_distances(outputs: GraspOutputs, targets: GraspTargets, min_quality: float) -> Tensor:
    """Return distances (B,) of the best predicted grasps from good ones (m); infinite without a good one."""
    best = outputs.quality.argmax(dim=1)
    distances = compute_grasp_distances(outputs, targets)[torch.arange(len(best), device=best.device), best]
    nearest: Tensor = distances.masked_fill(targets.quality < min_quality, torch.inf).amin(dim=1)
    return nearest
