"""Point cloud encoder PointNet++ (Qi et al., NeurIPS 2017).

Clouds have shape (B, 4, N): xyz of each point in the hand link's frame (m), and a zero. Sampling and grouping choose
the same points as the CUDA kernels of pointnet2_ops (Wijmans, 2018), with which published weights were trained.
"""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

#: Squared distance from the origin (m^2) up to which the kernels treat a point as padding: it is
#: never sampled except as the first point.
PADDING_SQUARED_NORM = 1e-3


def sample_farthest_points(points: Tensor, count: int) -> Tensor:
    """Sample points by farthest point sampling, beginning with the first point of each cloud.

    Points near the origin (`PADDING_SQUARED_NORM`) count as padding and are sampled only as the first point.

    Args:
        points: (B, N, 3) positions (m).
        count: Number of samples; if it exceeds N, points are repeated.

    Returns:
        (B, count) indices of the sampled points, int64.
    """
    batch = torch.arange(len(points), device=points.device)
    padding = (points**2).sum(dim=-1) <= PADDING_SQUARED_NORM
    distances = torch.full(points.shape[:2], 1e10, dtype=points.dtype, device=points.device)
    chosen = torch.zeros((len(points), count), dtype=torch.long, device=points.device)
    for number in range(1, count):
        last = points[batch, chosen[:, number - 1]]
        distances = torch.minimum(distances, ((points - last[:, None]) ** 2).sum(dim=-1))
        chosen[:, number] = distances.masked_fill(padding, -1.0).argmax(dim=1)
    return chosen


def query_ball(points: Tensor, centers: Tensor, radius: float, count: int) -> Tensor:
    """Return indices of the first points, in the cloud's order, within a radius of each center.

    Args:
        points: (B, N, 3) positions (m).
        centers: (B, M, 3) positions (m).
        radius: Radius (m), exclusive.
        count: Number of points per center. If fewer are within the radius, the first of them is repeated; if none is,
            point 0.

    Returns:
        (B, M, count) indices of points, int64.
    """
    n_points = points.shape[1]
    # The kernel squares the radius in single precision.
    near = ((centers[:, :, None] - points[:, None]) ** 2).sum(dim=-1) < points.new_tensor(radius) ** 2
    order = torch.arange(n_points, device=points.device).expand_as(near).masked_fill(~near, n_points)
    first = order.sort(dim=-1).values[..., :count]
    if n_points < count:
        missing = first.new_full((*first.shape[:2], count - n_points), n_points)
        first = torch.cat([first, missing], dim=-1)
    return first.where(first < n_points, first[..., :1]) % n_points


def gather_columns(values: Tensor, indices: Tensor) -> Tensor:
    """Return the columns of values (B, C, N) at indices (B, ...), as (B, C, ...)."""
    flat = indices.flatten(start_dim=1)[:, None].expand(-1, values.shape[1], -1)
    return values.gather(2, flat).reshape(*values.shape[:2], *indices.shape[1:])


class SetAbstraction(nn.Module):
    """Shared multilayer perceptron on groups of points, followed by max pooling.

    Layers are named as in pointnet2_ops, so that its weights can be loaded.

    Args:
        channels: Number of input channels without the position, then the width of every layer.
        n_groups: Number of groups: balls around centers from farthest point sampling; 0 makes one group of all points.
        radius: Radius of the balls (m).
        group_size: Number of points per ball.
    """

    def __init__(self, channels: Sequence[int], n_groups: int = 0, radius: float = 0.0, group_size: int = 0) -> None:
        super().__init__()
        self.n_groups, self.radius, self.group_size = n_groups, radius, group_size
        widths = (channels[0] + 3, *channels[1:])
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv2d(before, after, kernel_size=1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        self.mlps = nn.ModuleList([nn.Sequential(*layers)])

    def forward(self, positions: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Compute one feature vector per group of points.

        Args:
            positions: (B, N, 3) positions (m).
            features: (B, channels[0], N) features.

        Returns:
            (B, M, 3) centers of the M groups (m), or the origin for one group of all points; and
            (B, channels[-1], M) features of the groups.
        """
        xyz = positions.transpose(1, 2)
        if not self.n_groups:
            centers = positions.new_zeros((len(positions), 1, 3))
            groups = torch.cat([xyz, features], dim=1)[:, :, None]
        else:
            columns = gather_columns(xyz, sample_farthest_points(positions, self.n_groups))
            centers = columns.transpose(1, 2)
            # Repeated points do not change the maximum of a group, but take time in a training.
            count = min(self.group_size, positions.shape[1]) if self.training else self.group_size
            near = query_ball(positions, centers, self.radius, count)
            relative = gather_columns(xyz, near) - columns[..., None]
            groups = torch.cat([relative, gather_columns(features, near)], dim=1)
        return centers, self.mlps[0](groups).amax(dim=-1)


class PointNetPlusPlus(nn.Module):
    """PointNet++ encoder of GA-DDPG: three set abstractions and two dense layers.

    The output depends on which point of a cloud is the first, since farthest point sampling starts there. The order of
    the other points matters only if a ball contains more points than the size of its group.
    """

    n_features = 512

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            [
                SetAbstraction((4, 64, 64, 128), 32, 0.02, 64),
                SetAbstraction((128, 128, 128, 256), 32, 0.04, 128),
                SetAbstraction((256, 256, 256, 512)),
            ]
        )
        layers = (nn.Linear(512, 1024), nn.BatchNorm1d(1024), nn.ReLU(), nn.Linear(1024, 512), nn.BatchNorm1d(512))
        self.dense = nn.Sequential(*layers, nn.ReLU())

    def forward(self, cloud: Tensor) -> Tensor:
        """Encode clouds (B, 4, N) as vectors (B, 512)."""
        positions, features = cloud[:, :3].transpose(1, 2), cloud
        for stage in self.stages:
            positions, features = stage(positions, features)
        vector: Tensor = self.dense(features[..., 0])
        return vector
