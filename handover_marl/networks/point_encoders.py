"""What makes a vector of a cloud: PointNet++ (Qi et al., NeurIPS 2017) and a light PointNet (Qi et al., CVPR 2017).

Clouds are (B, c, N): c channels a point, the first three xyz in the hand link's frame (m).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from handover_marl.networks.point_sampling import ball_neighbours, farthest_points, gathered


@dataclass(frozen=True)
class Grouping:
    """Where a set abstraction looks.

    Attributes:
        centers: How many farthest points are looked around.
        radius: How far (m).
        neighbours: How many points are looked at around each.
    """

    centers: int
    radius: float
    neighbours: int


class SetAbstraction(nn.Module):
    """A small network on every group of points, of which the largest values are kept.

    Layers have the names that pointnet2_ops gives them, so that weights trained with it fit.

    Args:
        channels: Numbers a point before the first layer, without the place that is put before them, and after every
            layer.
        grouping: Where it looks; None takes all points as one group, at their places.
    """

    def __init__(self, channels: Sequence[int], grouping: Grouping | None = None) -> None:
        super().__init__()
        self.grouping = grouping
        widths = (channels[0] + 3, *channels[1:])
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv2d(before, after, kernel_size=1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        self.mlps = nn.ModuleList([nn.Sequential(*layers)])

    def forward(self, places: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Summarise a cloud by fewer points.

        Args:
            places: (B, N, 3) (m).
            features: (B, channels[0], N).

        Returns:
            (B, M, 3) places of the groups, relative to which their points were seen, and (B, channels[-1], M) features;
            for one group of all points M is 1, and its place the origin.
        """
        xyz = places.transpose(1, 2)
        if self.grouping is None:
            centers = places.new_zeros((len(places), 1, 3))
            groups = torch.cat([xyz, features], dim=1)[:, :, None]
        else:
            around = gathered(xyz, farthest_points(places, self.grouping.centers))
            centers = around.transpose(1, 2)
            near = ball_neighbours(places, centers, self.grouping.radius, self.grouping.neighbours)
            groups = torch.cat([gathered(xyz, near) - around[..., None], gathered(features, near)], dim=1)
        return centers, self.mlps[0](groups).amax(dim=-1)


class PointNetPlusPlus(nn.Module):
    """The encoder of GA-DDPG, handover-sim2real and GenH2R: three set abstractions and two dense layers.

    It sees patches of 2 cm. What it says depends on which point comes first, and, where more points are near a center
    than are looked at, on their order; else on the set of points alone.

    Args:
        n_channels: c, numbers a point, with xyz: 4 in GA-DDPG, 5 in handover-sim2real, 14 in GenH2R.
    """

    n_features = 512

    def __init__(self, n_channels: int = 4) -> None:
        super().__init__()
        self.n_channels = n_channels
        self.stages = nn.ModuleList(
            [
                SetAbstraction((n_channels, 64, 64, 128), Grouping(32, 0.02, 64)),
                SetAbstraction((128, 128, 128, 256), Grouping(32, 0.04, 128)),
                SetAbstraction((256, 256, 256, 512)),
            ]
        )
        layers = (nn.Linear(512, 1024), nn.BatchNorm1d(1024), nn.ReLU(), nn.Linear(1024, 512), nn.BatchNorm1d(512))
        self.dense = nn.Sequential(*layers, nn.ReLU())

    def forward(self, cloud: Tensor) -> Tensor:
        """(B, 512) for (B, c, N)."""
        places, features = cloud[:, :3].transpose(1, 2), cloud
        for stage in self.stages:
            places, features = stage(places, features)
        vector: Tensor = self.dense(features[..., 0])
        return vector


class PointNet(nn.Module):
    """A light encoder: the same small network on every point, of which the largest values are kept.

    What it says depends on the set of points alone, neither on their order nor on repeats. It has no batch statistics.

    Args:
        n_channels: c, numbers a point, with xyz.
        n_features: Length of the vector.
        scale: What coordinates are multiplied by first, so that numbers are near one (1/m).
    """

    def __init__(self, n_channels: int = 4, n_features: int = 256, scale: float = 10.0) -> None:
        super().__init__()
        self.n_channels, self.n_features = n_channels, n_features
        factors = torch.ones(n_channels, 1)
        factors[:3] = scale
        self.factors: Tensor
        self.register_buffer("factors", factors)
        widths = (n_channels, 64, 128, n_features)
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv1d(before, after, kernel_size=1), nn.ReLU()]
        self.points = nn.Sequential(*layers)
        self.dense = nn.Sequential(nn.Linear(n_features, n_features), nn.LayerNorm(n_features), nn.ReLU())

    def forward(self, cloud: Tensor) -> Tensor:
        """(B, n_features) for (B, c, N)."""
        vector: Tensor = self.dense(self.points(cloud * self.factors).amax(dim=-1))
        return vector
