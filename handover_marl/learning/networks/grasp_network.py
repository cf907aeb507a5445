"""Network that predicts grasps, and their quality, at many points of an observed object.

As in Contact-GraspNet (Sundermeyer et al., ICRA 2021), the network predicts a grasp next to each point, and the best
one is chosen: a single regression for the whole cloud would average distant grasps. Clouds contain the object and the
person's hand, in the frame of the robot's hand link (m).
"""

import itertools
from typing import Any, NamedTuple

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.learning.networks.weights import SavedNetwork

# Factors that bring local coordinates and those in the hand link's frame to order one (1/m).
_NEAR_SCALE, _FAR_SCALE = 20.0, 2.0
_N_ROTATION = 6
# Numbers of features that the network computes of each point, of each group of points and of the whole cloud.
_POINT_WIDTH, _GROUP_WIDTH, _CLOUD_WIDTH = 128, 128, 256
# Width of the layers that predict grasps, and numbers of points in the groups around each center, from fine to coarse.
_HEAD_WIDTH, _GROUP_SIZES = 256, (8, 32)


class GraspOutputs(NamedTuple):
    """Predicted grasps for B clouds at C points (centers) each, in the hand link's frame.

    Attributes:
        quality: (B, C) logits of the quality (0 to 1) of the grasp at a center; a higher one is better.
        positions: (B, C, 3) points between the finger pads at the grasps (m).
        rotations: (B, C, 3, 3) orientations of the Panda's hand link; a rotation by pi about z is equivalent.
        object_center: (B, 3) center of the whole object, with its unobserved parts (m).
        object_motion: (B, 3) predicted displacement of the object in the coming 0.5 s (m).
    """

    quality: Tensor
    positions: Tensor
    rotations: Tensor
    object_center: Tensor
    object_motion: Tensor


class PointCloudBatch(NamedTuple):
    """Inputs of the grasp network: B point clouds in the frame of the Panda's hand link.

    Attributes:
        object_points: (B, N, 3) points of the object (m).
        hand_points: (B, M, 3) points of the person's hand (m).
        hand_mask: (B, M) whether a point of the person's hand is valid; others are padding.
        center_indices: (B, C) indices of the object's points ("centers") at which grasps are predicted.
        object_velocity: (B, 3) velocity of the object (m/s).
    """

    object_points: Tensor
    hand_points: Tensor
    hand_mask: Tensor
    center_indices: Tensor
    object_velocity: Tensor

    def get_center_points(self) -> Tensor:
        """Return the object points (B, C, 3) in m with the indices `center_indices`: the places of predicted grasps."""
        return self.object_points.gather(1, self.center_indices[..., None].expand(-1, -1, 3))


def _layers(*widths: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers)


class GraspNetwork(SavedNetwork):
    """Grasp predictor of the receiver `vision`; predictions do not depend on the order of the points in a cloud."""

    kind = "vision"

    def __init__(self) -> None:
        super().__init__()
        self.points = _layers(7, 64, _POINT_WIDTH)
        self.whole = nn.ModuleList([_layers(_POINT_WIDTH, _CLOUD_WIDTH) for _ in range(2)])
        self.mixed = _layers(2 * _CLOUD_WIDTH + 3, _CLOUD_WIDTH, _CLOUD_WIDTH)
        # Linear in positions relative to the center, so that each point is encoded only once.
        self.inner = nn.ModuleList([nn.Linear(_POINT_WIDTH, _GROUP_WIDTH) for _ in _GROUP_SIZES])
        self.outer = nn.ModuleList([nn.Linear(3, _GROUP_WIDTH, bias=False) for _ in _GROUP_SIZES])
        width = _POINT_WIDTH + len(_GROUP_SIZES) * _GROUP_WIDTH + _CLOUD_WIDTH + 3
        self.grasp = nn.Sequential(_layers(width, _HEAD_WIDTH, _HEAD_WIDTH), nn.Linear(_HEAD_WIDTH, 4 + _N_ROTATION))
        self.rest = nn.Sequential(_layers(_CLOUD_WIDTH, _HEAD_WIDTH), nn.Linear(_HEAD_WIDTH, 6))

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> "GraspNetwork":
        """Create an untrained network; `settings` are ignored, because all networks have the same layer widths."""
        return cls()

    def forward(self, clouds: PointCloudBatch) -> GraspOutputs:
        """Predict grasps and their quality at C centers of each of B clouds, and the objects' centers and motions."""
        n_object = clouds.object_points.shape[1]
        mean = clouds.object_points.mean(dim=1, keepdim=True)
        positions = torch.cat([clouds.object_points, clouds.hand_points], dim=1)
        is_hand = torch.zeros_like(positions[..., :1])
        is_hand[:, n_object:] = 1.0
        local = _NEAR_SCALE * 0.5 * (positions - mean)
        points = self.points(torch.cat([local, _FAR_SCALE * positions, is_hand], dim=-1))
        mask = torch.cat([torch.ones_like(clouds.object_points[..., 0], dtype=torch.bool), clouds.hand_mask], dim=1)
        whole = self._encode_cloud(points, mask, clouds)
        centers = clouds.get_center_points()
        features = [
            points.gather(1, clouds.center_indices[..., None].expand(-1, -1, points.shape[-1])),
            *self._encode_groups(points, positions - mean, mask, centers - mean),
            whole[:, None].expand(-1, centers.shape[1], -1),
            0.5 * _NEAR_SCALE * (centers - mean),
        ]
        grasps = self.grasp(torch.cat(features, dim=-1)).float()
        rest = self.rest(whole).float()
        return GraspOutputs(
            grasps[..., 0],
            centers + grasps[..., 1:4] / _NEAR_SCALE,
            rotations_from_6d(grasps[..., 4:]),
            mean[:, 0] + rest[:, :3] / _NEAR_SCALE,
            rest[:, 3:] / _NEAR_SCALE,
        )

    def _encode_cloud(self, points: Tensor, mask: Tensor, clouds: PointCloudBatch) -> Tensor:
        """Return the features (B, 256) of clouds.

        Args:
            points: (B, N + M, 128) features of the points: N of the object, then M of the person's hand.
            mask: (B, N + M) whether a point is valid; others are padding.
            clouds: The clouds, with the velocities of the objects.
        """
        n_object = clouds.object_points.shape[1]
        object_features = self.whole[0](points[:, :n_object]).max(dim=1).values
        hand_features = (self.whole[1](points[:, n_object:]) * mask[:, n_object:, None]).max(dim=1).values
        whole: Tensor = self.mixed(torch.cat([object_features, hand_features, clouds.object_velocity], dim=-1))
        return whole

    def _encode_groups(self, points: Tensor, positions: Tensor, mask: Tensor, centers: Tensor) -> list[Tensor]:
        """Return features (B, C, 128) of the nearest points of each center, one tensor per group size.

        Args:
            points: (B, N + M, 128) features of the points.
            positions: (B, N + M, 3) positions relative to the mean of the object's points (m).
            mask: (B, N + M) whether a point is valid.
            centers: (B, C, 3) positions relative to the same mean (m).
        """
        with torch.no_grad():
            distances = torch.cdist(centers, positions).masked_fill(~mask[:, None], torch.inf)
            near = distances.topk(max(_GROUP_SIZES), dim=-1, largest=False).indices
        near, features = near + positions.shape[1] * torch.arange(len(points), device=near.device)[:, None, None], []
        for count, inner, outer in zip(_GROUP_SIZES, self.inner, self.outer, strict=True):
            # Invalid points are never among the nearest, since the object has more points than a group.
            members = (inner(points) + outer(_NEAR_SCALE * positions)).flatten(0, 1)
            pooled = func.embedding_bag(near[..., :count].reshape(-1, count), members, mode="max")
            features.append(func.relu(pooled.view(*centers.shape[:2], -1) - outer(_NEAR_SCALE * centers)))
        return features


def rotations_from_6d(vectors: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) from vectors (..., 6): z axis, then y axis, which are orthonormalized.

    See Zhou et al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019.
    """
    z = func.normalize(vectors[..., :3], dim=-1)
    y = vectors[..., 3:] - (z * vectors[..., 3:]).sum(dim=-1, keepdim=True) * z
    y = func.normalize(y, dim=-1)
    return torch.stack([torch.linalg.cross(y, z, dim=-1), y, z], dim=-1)
