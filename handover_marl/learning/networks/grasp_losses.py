"""Losses of the grasp network: distances of predicted grasps from good grasps of an object."""

from typing import NamedTuple

import torch
import torch.nn.functional as func
from torch import Tensor

from handover_marl.geometry.panda import PAD_DISTANCE
from handover_marl.learning.networks.grasp_network import GraspOutputs

# Distance of two finger points from the point between the pads, which makes rotations count (m).
_FINGER_OFFSET = 0.04
# Half sizes of the box between the closed pads: object points in it belong to the grasp (m).
_PAD_VOLUME_HALF_SIZES = (0.015, 0.045, 0.025)
# Distance by which a grasp of quality 1 may be farther away than one of quality 0 (m).
_QUALITY_BONUS = 0.03
# Distance at which the quality of a prediction has decayed to 1/e of that of the good grasp (m).
_QUALITY_DECAY = 0.02


class GraspTargets(NamedTuple):
    """Targets of the grasp network: K good grasps for each of B clouds, in the cloud's frame.

    Attributes:
        positions: (B, K, 3) points between the pads (m).
        rotations: (B, K, 3, 3) orientations of the hand link.
        quality: (B, K) quality from 0 (padding) to 1.
    """

    positions: Tensor
    rotations: Tensor
    quality: Tensor


class GraspLosses(NamedTuple):
    """Losses of the grasp network, averaged over a batch.

    Attributes:
        grasp: Distance of predicted grasps from the good grasps matched to them (m).
        quality: Binary cross entropy of the predicted quality.
        object_center: Distance of the predicted from the true center of the object (m).
        object_motion: Distance of the predicted from the true displacement of the object (m).
    """

    grasp: Tensor
    quality: Tensor
    object_center: Tensor
    object_motion: Tensor


def grasp_targets_from_poses(poses: Tensor, quality: Tensor) -> GraspTargets:
    """Return targets of the grasp network, made from hand poses at good grasps and their qualities.

    Args:
        poses: (B, K, 7) poses of the hand link at the grasps, in the cloud's frame: xyz (m) and
            quaternion xyzw.
        quality: (B, K) quality from 0 (padding) to 1.
    """
    x, y, z, w = func.normalize(poses[..., 3:], dim=-1).unbind(dim=-1)
    y_axis = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1)
    z_axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1)
    rotations = torch.stack([torch.linalg.cross(y_axis, z_axis, dim=-1), y_axis, z_axis], dim=-1)
    return GraspTargets(poses[..., :3] + PAD_DISTANCE * z_axis, rotations, quality)


def compute_grasp_distances(outputs: GraspOutputs, targets: GraspTargets) -> Tensor:
    """Return the distance (B, C, K) in m between each predicted and each good grasp.

    A distance is the mean over three points of the gripper (hand and both finger pads). A rotation
    of the gripper by pi about its z axis does not change the distance.

    Args:
        outputs: Predicted grasps at C centers of each of B clouds.
        targets: K good grasps for each cloud.
    """
    return _gripper_distances(
        outputs.positions[:, :, None],
        outputs.rotations[:, :, None],
        targets.positions[:, None],
        targets.rotations[:, None],
    )


def find_enclosed_centers(centers: Tensor, targets: GraspTargets) -> Tensor:
    """Return a mask (B, C, K) of the good grasps whose closing pads enclose each object point.

    Args:
        centers: (B, C, 3) points of the object (m).
        targets: K good grasps for each of B clouds.
    """
    offsets = centers[:, :, None] - targets.positions[:, None]
    local = torch.einsum("bcki,bkij->bckj", offsets, targets.rotations)
    is_enclosed = (local.abs() < local.new_tensor(_PAD_VOLUME_HALF_SIZES)).all(dim=-1)
    return is_enclosed & (targets.quality > 0.0)[:, None]


def compute_grasp_losses(
    outputs: GraspOutputs, centers: Tensor, targets: GraspTargets, object_center: Tensor, object_motion: Tensor
) -> GraspLosses:
    """Return the losses of the grasp network, averaged over a batch of clouds.

    Each center is matched to the nearest good grasp whose closing pads enclose it, where grasps of
    higher quality are preferred. Centers without such a grasp only contribute to the loss of the
    quality.

    Args:
        outputs: Predictions of the grasp network.
        centers: (B, C, 3) points at which grasps were predicted (m).
        targets: Good grasps.
        object_center: (B, 3) centers of the objects (m).
        object_motion: (B, 3) displacements of the objects within the prediction time (m).
    """
    with torch.no_grad():
        distances = compute_grasp_distances(outputs, targets)
        costs = distances - _QUALITY_BONUS * targets.quality[:, None]
        nearest = costs.masked_fill(~find_enclosed_centers(centers, targets), torch.inf).min(dim=-1)
        quality = (targets.quality[:, None] * torch.exp(-((distances / _QUALITY_DECAY) ** 2))).amax(dim=-1)
    is_matched = torch.isfinite(nearest.values)
    matched = _gripper_distances(
        outputs.positions,
        outputs.rotations,
        targets.positions.gather(1, nearest.indices[..., None].expand(-1, -1, 3)),
        targets.rotations.gather(1, nearest.indices[..., None, None].expand(-1, -1, 3, 3)),
    )
    return GraspLosses(
        (matched * is_matched).sum() / is_matched.sum().clamp(min=1),
        func.binary_cross_entropy_with_logits(outputs.quality, quality),
        (outputs.object_center - object_center).norm(dim=-1).mean(),
        (outputs.object_motion - object_motion).norm(dim=-1).mean(),
    )


def _gripper_distances(positions: Tensor, rotations: Tensor, targets: Tensor, target_rotations: Tensor) -> Tensor:
    """Return mean distances (...) of three gripper points for positions (..., 3) and rotations (..., 3, 3)."""
    offset = positions - targets
    wrist = positions - PAD_DISTANCE * rotations[..., 2] - (targets - PAD_DISTANCE * target_rotations[..., 2])
    finger, target_finger = _FINGER_OFFSET * rotations[..., 1], _FINGER_OFFSET * target_rotations[..., 1]
    same = (offset + finger - target_finger).norm(dim=-1) + (offset - finger + target_finger).norm(dim=-1)
    flipped = (offset + finger + target_finger).norm(dim=-1) + (offset - finger - target_finger).norm(dim=-1)
    distances: Tensor = (wrist.norm(dim=-1) + torch.minimum(same, flipped)) / 3.0
    return distances
