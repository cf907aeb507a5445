"""Network that predicts grasps, and their quality, at many points of an observed object.

As in Contact-GraspNet (Sundermeyer et al., ICRA 2021), each point predicts the grasp next to it,
and the best one is chosen: a single regression for the whole cloud would average distant grasps.
Clouds contain the object and the person's hand, in the hand link's frame (m).
"""

import itertools
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.learning.networks.weights import SavedNetwork

# Factors that bring local coordinates and those in the hand link's frame to order one (1/m).
_NEAR_SCALE, _FAR_SCALE = 20.0, 2.0
_N_ROTATION = 6
# Present names of the settings by their names in the shipped weight files, which are of an earlier version.
_OLD_NAMES = {
    "points": "point_width",
    "group": "group_width",
    "whole": "cloud_width",
    "grasp": "head_width",
    "groups": "group_sizes",
}

_Self = TypeVar("_Self", bound="GraspNetwork")


@dataclass(frozen=True)
class GraspNetworkConfig:
    """Widths of the layers of the grasp network, and sizes of its groups of points.

    Attributes:
        point_width: Number of features that the network computes of each point.
        group_width: Number of features that the network computes of each group of points.
        cloud_width: Number of features that the network computes of the whole cloud.
        head_width: Width of the layers that predict grasps.
        group_sizes: Numbers of points in the groups around each center, from fine to coarse.
    """

    point_width: int = 128
    group_width: int = 128
    cloud_width: int = 256
    head_width: int = 256
    group_sizes: tuple[int, ...] = (8, 32)


class GraspOutputs(NamedTuple):
    """Predicted grasps for B clouds at C points (centers) each, in the hand link's frame.

    Attributes:
        quality: (B, C) logits of the quality (0 to 1) of the grasp at a center.
        positions: (B, C, 3) points between the finger pads at the grasps (m).
        rotations: (B, C, 3, 3) orientations of the Panda's hand link; a rotation by pi about z is equivalent.
        object_center: (B, 3) center of the whole object, with its unobserved parts (m).
        object_motion: (B, 3) displacement of the object in the coming 0.5 s, as in the training data (m).
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
    """Grasp predictor of the receiver `vision`; independent of the order and repetition of points.

    Args:
        config: Widths of the layers and sizes of the groups.
    """

    kind = "vision"

    def __init__(self, config: GraspNetworkConfig = GraspNetworkConfig()) -> None:
        super().__init__()
        self.config = config
        self.points = _layers(7, 64, config.point_width)
        self.whole = nn.ModuleList([_layers(config.point_width, config.cloud_width) for _ in range(2)])
        self.mixed = _layers(2 * config.cloud_width + 3, config.cloud_width, config.cloud_width)
        # Linear in positions relative to the center, so that each point is encoded only once.
        self.inner = nn.ModuleList([nn.Linear(config.point_width, config.group_width) for _ in config.group_sizes])
        self.outer = nn.ModuleList([nn.Linear(3, config.group_width, bias=False) for _ in config.group_sizes])
        width = config.point_width + len(config.group_sizes) * config.group_width + config.cloud_width + 3
        self.grasp = nn.Sequential(
            _layers(width, config.head_width, config.head_width), nn.Linear(config.head_width, 4 + _N_ROTATION)
        )
        self.rest = nn.Sequential(_layers(config.cloud_width, config.head_width), nn.Linear(config.head_width, 6))

    def get_settings(self) -> dict[str, Any]:
        """Return the fields of `config` by name, in JSON types."""
        return asdict(self.config)

    @classmethod
    def from_settings(cls: "type[_Self]", settings: dict[str, Any]) -> "_Self":
        """Create an untrained network from the fields of its configuration, as returned by `get_settings`.

        Raises:
            ValueError: The network was trained without the points of the person's hand, as an ablation.
        """
        named = {_OLD_NAMES.get(name, name): value for name, value in settings.items() if name != "hand"}
        if not settings.get("hand", True):
            raise ValueError("networks without points of the person's hand are not supported")
        return cls(GraspNetworkConfig(**(named | {"group_sizes": tuple(named["group_sizes"])})))

    def forward(self, clouds: PointCloudBatch) -> GraspOutputs:
        """Predict grasps and their quality at C centers of each of B clouds, and center and motion of the objects."""
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
        """Return features (B, cloud_width) of clouds from features (B, N + M, point_width), the object's first."""
        n_object = clouds.object_points.shape[1]
        object_features = self.whole[0](points[:, :n_object]).max(dim=1).values
        hand_features = (self.whole[1](points[:, n_object:]) * mask[:, n_object:, None]).max(dim=1).values
        whole: Tensor = self.mixed(torch.cat([object_features, hand_features, clouds.object_velocity], dim=-1))
        return whole

    def _encode_groups(self, points: Tensor, positions: Tensor, mask: Tensor, centers: Tensor) -> list[Tensor]:
        """Return features (B, C, group_width) of the nearest points of each center, one tensor per group size.

        Args:
            points: (B, N + M, point_width) features of the points.
            positions: (B, N + M, 3) positions relative to the mean of the object's points (m).
            mask: (B, N + M) valid points.
            centers: (B, C, 3) positions relative to the same mean (m).
        """
        with torch.no_grad():
            distances = torch.cdist(centers, positions).masked_fill(~mask[:, None], torch.inf)
            near = distances.topk(max(self.config.group_sizes), dim=-1, largest=False).indices
        batch, features = torch.arange(len(points), device=points.device)[:, None, None], []
        for count, inner, outer in zip(self.config.group_sizes, self.inner, self.outer, strict=True):
            # Invalid points are never among the nearest, since the object has more points than a group.
            members = (inner(points) + outer(_NEAR_SCALE * positions))[batch, near[..., :count]]
            pooled = members.max(dim=2).values
            features.append(func.relu(pooled - outer(_NEAR_SCALE * centers)))
        return features


def rotations_from_6d(vectors: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) from six numbers (..., 6): z axis, then y axis, which are orthonormalized.

    See Zhou et al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019.
    """
    z = func.normalize(vectors[..., :3], dim=-1)
    y = vectors[..., 3:] - (z * vectors[..., 3:]).sum(dim=-1, keepdim=True) * z
    y = func.normalize(y, dim=-1)
    return torch.stack([torch.linalg.cross(y, z, dim=-1), y, z], dim=-1)
