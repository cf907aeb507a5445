"""Training, losses and metrics of the grasp network. The module needs the extra `train`.

The distance between two grasps is the mean distance between three points of the gripper (hand link and two points of
the fingers) at one grasp and at the other. A rotation of a grasp by pi about its z axis does not change the distance.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as func
from torch import Tensor

from handover_marl.geometry.panda import PAD_DISTANCE
from handover_marl.geometry.rotations import matrices_from_quaternions
from handover_marl.learning.imitation.run import Batches, ImitationLearner
from handover_marl.learning.imitation.vision.views import GraspViews
from handover_marl.learning.networks.grasp_network import GraspNetwork, GraspOutputs, PointCloudBatch

# Distance of two finger points from the point between the pads, which makes rotations count (m).
_FINGER_OFFSET = 0.04
# Half sizes of the box between the closed pads: object points in it belong to the grasp (m).
_PAD_VOLUME_HALF_SIZES = (0.015, 0.045, 0.025)
# Distance by which a grasp of quality 1 may be farther away than one of quality 0 (m).
_QUALITY_BONUS = 0.03
# Distance at which the quality of a prediction has decayed to 1/e of that of the good grasp (m).
_QUALITY_DECAY = 0.02
# Number of points per view at which grasps are predicted.
_N_CENTERS = 48
# Weights of the losses of the predicted grasps (1/m), of their quality, and of the object's predicted center (1/m) and
# displacement (1/m).
_LOSS_WEIGHTS = {"grasp": 10.0, "quality": 2.0, "object_center": 2.0, "object_motion": 1.0}
# Standard deviations of the random rotation of each view about the line of sight (rad), and of the noise that is added
# to the coordinates of points (m).
_ROLL_STD, _POINT_NOISE_STD = 0.6, 0.001
# Number of held-out views that are evaluated together, and smallest quality of a good grasp in metrics.
_N_EVALUATED, _GOOD_QUALITY = 256, 0.3


class GraspTargets(NamedTuple):
    """Targets of the grasp network: K good grasps for each of B clouds, in the cloud's frame.

    Attributes:
        positions: (B, K, 3) points between the finger pads (m).
        rotations: (B, K, 3, 3) orientations of the Panda's hand link.
        quality: (B, K) quality from 0 (padding) to 1.
    """

    positions: Tensor
    rotations: Tensor
    quality: Tensor


class LabelledClouds(NamedTuple):
    """Batch of B point clouds with training targets of the grasp network.

    Attributes:
        clouds: Inputs of the network.
        targets: Good grasps, which the network should predict.
        object_center: (B, 3) centers of the objects (m).
        object_motion: (B, 3) displacements of the objects in the coming 0.5 s (m).
    """

    clouds: PointCloudBatch
    targets: GraspTargets
    object_center: Tensor
    object_motion: Tensor


def grasp_targets_from_poses(poses: Tensor, quality: Tensor) -> GraspTargets:
    """Return targets of the grasp network from poses of the Panda's hand link at good grasps and their qualities.

    Args:
        poses: (B, K, 7) poses of the hand link at the grasps, in the cloud's frame: xyz (m) and quaternion xyzw; zeros
            for padding.
        quality: (B, K) quality from 0 (padding) to 1.
    """
    is_padding = (poses[..., 3:] == 0.0).all(dim=-1, keepdim=True)
    quaternions = poses[..., 3:] + is_padding * poses.new_tensor([0.0, 0.0, 0.0, 1.0])
    rotations = matrices_from_quaternions(quaternions).to(poses.dtype)
    return GraspTargets(poses[..., :3] + PAD_DISTANCE * rotations[..., 2], rotations, quality)


def compute_grasp_distances(outputs: GraspOutputs, targets: GraspTargets) -> Tensor:
    """Return the distances (B, C, K) in m between grasps predicted at C centers and K good grasps of B clouds."""
    return _gripper_distances(
        outputs.positions[:, :, None],
        outputs.rotations[:, :, None],
        targets.positions[:, None],
        targets.rotations[:, None],
    )


def find_enclosed_centers(centers: Tensor, targets: GraspTargets) -> Tensor:
    """Return whether the closing pads of K good grasps enclose object points (B, C, 3) of B clouds, (B, C, K)."""
    offsets = centers[:, :, None] - targets.positions[:, None]
    local = torch.einsum("bcki,bkij->bckj", offsets, targets.rotations)
    is_enclosed = (local.abs() < local.new_tensor(_PAD_VOLUME_HALF_SIZES)).all(dim=-1)
    return is_enclosed & (targets.quality > 0.0)[:, None]


def compute_grasp_losses(outputs: GraspOutputs, batch: LabelledClouds) -> dict[str, Tensor]:
    """Return the losses of the grasp network, averaged over a batch of clouds.

    A center is a point of the object at which the network predicts a grasp. Candidates for a match are the good grasps
    whose closing pads enclose the center; the one nearest to the predicted grasp is matched, where a grasp of quality 1
    may be up to 3 cm farther away than one of quality 0. Centers without candidates count only in the loss of quality.

    Returns:
        "grasp", the distance of predicted grasps from the good grasps matched to them (m); "quality", the binary cross
        entropy of the predicted quality; "object_center" and "object_motion", distances from the true ones (m).
    """
    targets = batch.targets
    with torch.no_grad():
        distances = compute_grasp_distances(outputs, targets)
        costs = distances - _QUALITY_BONUS * targets.quality[:, None]
        enclosed = find_enclosed_centers(batch.clouds.get_center_points(), targets)
        nearest = costs.masked_fill(~enclosed, torch.inf).min(dim=-1)
        quality = (targets.quality[:, None] * torch.exp(-((distances / _QUALITY_DECAY) ** 2))).amax(dim=-1)
    is_matched = torch.isfinite(nearest.values)
    matched = _gripper_distances(
        outputs.positions,
        outputs.rotations,
        targets.positions.gather(1, nearest.indices[..., None].expand(-1, -1, 3)),
        targets.rotations.gather(1, nearest.indices[..., None, None].expand(-1, -1, 3, 3)),
    )
    return {
        "grasp": (matched * is_matched).sum() / is_matched.sum().clamp(min=1),
        "quality": func.binary_cross_entropy_with_logits(outputs.quality, quality),
        "object_center": (outputs.object_center - batch.object_center).norm(dim=-1).mean(),
        "object_motion": (outputs.object_motion - batch.object_motion).norm(dim=-1).mean(),
    }


def _gripper_distances(positions: Tensor, rotations: Tensor, targets: Tensor, target_rotations: Tensor) -> Tensor:
    """Return the distances (...) in m between grasps and targets, see the module.

    Both are points between the pads (..., 3) in m and orientations of the hand link (..., 3, 3).
    """
    offset = positions - targets
    wrist = offset - PAD_DISTANCE * (rotations[..., 2] - target_rotations[..., 2])
    finger, target_finger = _FINGER_OFFSET * rotations[..., 1], _FINGER_OFFSET * target_rotations[..., 1]
    same = (offset + finger - target_finger).norm(dim=-1) + (offset - finger + target_finger).norm(dim=-1)
    flipped = (offset + finger + target_finger).norm(dim=-1) + (offset - finger - target_finger).norm(dim=-1)
    distances: Tensor = (wrist.norm(dim=-1) + torch.minimum(same, flipped)) / 3.0
    return distances


class ViewBatches(Batches):
    """Data set of rendered views with good grasps, as tensors on a device, from which batches are selected."""

    def __init__(self, views: GraspViews, device: torch.device) -> None:
        super().__init__([torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in views])

    def sample(self, count: int, rng: np.random.Generator) -> LabelledClouds:
        """Return a batch of `count` randomly drawn and augmented views."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        numbers = torch.randint(len(self), (count,), generator=generator)
        return _augment(self.select(numbers, _N_CENTERS, generator), generator)

    def select(self, numbers: Tensor, centers: int, generator: torch.Generator) -> LabelledClouds:
        """Return a batch of views, each with random centers: points at which grasps are predicted.

        Args:
            numbers: (B,) indices of the views.
            centers: Number of centers per view, drawn among the object's points.
            generator: Generator that draws the centers.
        """
        parts = [tensor[numbers.to(tensor.device)].float() for tensor in self._samples]
        objects, hands, n_hands, grasps, quality, object_center, velocity, motion = parts
        indices = torch.rand(objects.shape[:2], generator=generator).argsort(dim=1)[:, :centers].to(objects.device)
        mask = torch.arange(hands.shape[1], device=hands.device) < n_hands[:, None]
        clouds = PointCloudBatch(objects, hands, mask, indices, velocity)
        return LabelledClouds(clouds, grasp_targets_from_poses(grasps, quality), object_center, motion)


def _augment(batch: LabelledClouds, generator: torch.Generator) -> LabelledClouds:
    """Return the batch with each view rotated randomly about the line of sight, and with noise on the points."""
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
        """Return the loss to minimize, and its parts from `compute_grasp_losses`, of which it is the weighted sum."""
        # Half precision suffices for training and takes a third of the time.
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.use_bfloat16):
            outputs = network(batch.clouds)
        losses = compute_grasp_losses(outputs, batch)
        return torch.stack([_LOSS_WEIGHTS[name] * loss for name, loss in losses.items()]).sum(), losses

    def evaluate(self, held_out: ViewBatches) -> dict[str, float]:
        """Return metrics of the network with averaged weights on held-out views, by name.

        Returns:
            views: Number of views with a good grasp, one of quality 0.3 or more.
            within_1cm, within_2cm: Shares of these views whose best predicted grasp is within 1 or 2 cm of a good one.
            median_distance: Median distance of the best predicted grasp from the nearest good one (m).
            grasp_loss, quality_loss: Losses "grasp" (m) and "quality" of `compute_grasp_losses`, means over all views.
        """
        distances, losses = [], []
        generator = torch.Generator().manual_seed(0)
        with torch.inference_mode():
            for numbers in torch.split(torch.arange(len(held_out)), _N_EVALUATED):
                batch = held_out.select(numbers, 2 * _N_CENTERS, generator)
                outputs = self.averaged_network(batch.clouds)
                found = compute_grasp_losses(outputs, batch)
                losses.append(torch.stack([found["grasp"], found["quality"]]) * len(numbers))
                best = outputs.quality.argmax(dim=1)
                all_distances = compute_grasp_distances(outputs, batch.targets)
                of_best = all_distances[torch.arange(len(best), device=best.device), best]
                distances.append(of_best.masked_fill(batch.targets.quality < _GOOD_QUALITY, torch.inf).amin(dim=1))
        nearest = torch.cat(distances)
        nearest = nearest[torch.isfinite(nearest)]
        grasp, quality = (torch.stack(losses).sum(dim=0) / max(1, len(held_out))).tolist()
        shares = {f"within_{n}cm": float((nearest < 0.01 * n).float().mean()) for n in (1, 2)}
        median = float(nearest.median()) if len(nearest) else math.nan
        return {
            "views": len(nearest),
            **shares,
            "median_distance": median,
            "grasp_loss": grasp,
            "quality_loss": quality,
        }
