"""Training and metrics of the grasp network. The module needs the extra `train`."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from handover_marl.learning.imitation.learner import ImitationLearner
from handover_marl.learning.imitation.vision.views import GraspViews
from handover_marl.learning.networks.grasp_losses import (
    GraspLosses,
    GraspTargets,
    compute_grasp_distances,
    compute_grasp_losses,
    grasp_targets_from_poses,
)
from handover_marl.learning.networks.grasp_network import GraspNetwork, GraspOutputs, PointCloudBatch

# Number of points per view at which grasps are predicted.
_N_CENTERS = 48
# Weights of the losses of the predicted grasps (1/m), of their quality, and of the object's predicted center (1/m) and
# displacement (1/m).
_GRASP_WEIGHT, _QUALITY_WEIGHT, _CENTER_WEIGHT, _MOTION_WEIGHT = 10.0, 2.0, 2.0, 1.0
# Standard deviations of the random rotation of each view about the line of sight (rad), and of the noise that is added
# to the coordinates of points (m).
_ROLL_STD, _POINT_NOISE_STD = 0.6, 0.001
# Number of held-out views that are evaluated together.
_N_EVALUATED = 256


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

    def sample(self, count: int, rng: np.random.Generator) -> LabelledClouds:
        """Return a batch of randomly drawn and augmented views."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        numbers = torch.randint(len(self), (count,), generator=generator)
        return _augment(self.select(numbers, _N_CENTERS, generator), generator)

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


def _augment(batch: LabelledClouds, generator: torch.Generator) -> LabelledClouds:
    """Return the batch rotated randomly about the line of sight, with noise on points."""
    clouds, targets = batch.clouds, batch.targets
    device = clouds.object_points.device
    angle = _ROLL_STD * torch.randn(len(clouds.object_points), generator=generator).to(device)
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = ([cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1.0])
    rotation = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    objects, hands = (
        cloud @ rotation.mT + _POINT_NOISE_STD * torch.randn(cloud.shape, generator=generator).to(device)
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


class GraspLearner(ImitationLearner[GraspNetwork, LabelledClouds]):
    """Trainer of the grasp network; reproducible for a seed, a device and a number of threads."""

    def compute_losses(self, network: GraspNetwork, batch: LabelledClouds) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss to minimize, and the losses in `GraspLosses` by name."""
        # Half precision suffices for training and takes a third of the time.
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._config.use_bfloat16):
            outputs = network(batch.clouds)
        losses = batch.compute_losses(outputs)
        total = _GRASP_WEIGHT * losses.grasp + _QUALITY_WEIGHT * losses.quality
        total = total + _CENTER_WEIGHT * losses.object_center
        return total + _MOTION_WEIGHT * losses.object_motion, losses._asdict()

    def evaluate(self, held_out: ViewBatches, min_quality: float = 0.3) -> dict[str, float]:
        """Return the accuracy of the predicted grasps on held-out views.

        A grasp is good if its quality is at least `min_quality`. Distances are those of
        `handover_marl.learning.networks.grasp_losses.compute_grasp_distances`.

        Returns:
            views: Number of views with at least one good grasp.
            within_1cm, within_2cm: Shares of these views whose best predicted grasp is within 1 or 2 cm of a good one.
            median_distance: Median distance of the best predicted grasp from a good one (m).
            grasp_loss, quality_loss: Losses of the grasps (m) and of their quality.
        """
        distances, losses = [], []
        generator = torch.Generator().manual_seed(0)
        with torch.inference_mode():
            for numbers in torch.split(torch.arange(len(held_out)), _N_EVALUATED):
                batch = held_out.select(numbers, 2 * _N_CENTERS, generator)
                outputs = self.averaged(batch.clouds)
                losses.append(torch.stack([*batch.compute_losses(outputs)]) * len(numbers))
                distances.append(_compute_best_distances(outputs, batch.targets, min_quality))
        best = torch.cat(distances)
        best = best[torch.isfinite(best)]
        means = torch.stack(losses).sum(dim=0) / max(1, len(held_out))
        median = float(best.median()) if len(best) else math.nan
        shares = {f"within_{n}cm": float((best < 0.01 * n).float().mean()) for n in (1, 2)}
        found = {"views": len(best), **shares, "median_distance": median}
        return {**found, "grasp_loss": float(means[0]), "quality_loss": float(means[1])}


def _compute_best_distances(outputs: GraspOutputs, targets: GraspTargets, min_quality: float) -> Tensor:
    """Return distances (B,) of the best predicted grasps from good ones (m); infinite without a good one."""
    best = outputs.quality.argmax(dim=1)
    distances = compute_grasp_distances(outputs, targets)[torch.arange(len(best), device=best.device), best]
    nearest: Tensor = distances.masked_fill(targets.quality < min_quality, torch.inf).amin(dim=1)
    return nearest
