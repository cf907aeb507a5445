"""Choosing points of clouds: farthest points and neighbours in a ball, on any device, without compiled code.

Both choose as the CUDA kernels of pointnet2_ops (Wijmans, 2018) do, which published weights were trained with. All
coordinates are in one frame (m).
"""

import torch
from torch import Tensor

#: Points this near to the origin (m^2, squared) are never chosen after the first: the kernels' guard against padding.
PADDING = 1e-3


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Which points are spread over a cloud: the first, then ever the one farthest from those chosen before.

    Which ones depends on which is first, not on the order of the others.

    Args:
        points: (B, N, 3).
        count: How many are wanted; more than there are repeats some.

    Returns:
        (B, count) long indices.
    """
    batch = torch.arange(len(points), device=points.device)
    padding = (points**2).sum(dim=-1) <= PADDING
    distances = torch.full(points.shape[:2], 1e10, dtype=points.dtype, device=points.device)
    chosen = torch.zeros((len(points), count), dtype=torch.long, device=points.device)
    for number in range(1, count):
        last = points[batch, chosen[:, number - 1]]
        distances = torch.minimum(distances, ((points - last[:, None]) ** 2).sum(dim=-1))
        chosen[:, number] = distances.masked_fill(padding, -1.0).argmax(dim=1)
    return chosen


def ball_neighbours(points: Tensor, centers: Tensor, radius: float, count: int) -> Tensor:
    """The first points of a cloud, in its order, that are nearer to centers than a radius.

    Args:
        points: (B, N, 3).
        centers: (B, M, 3).
        radius: Exclusive (m).
        count: How many are wanted; where there are fewer, the first is repeated, and where there are none, point 0.

    Returns:
        (B, M, count) long indices.
    """
    n_points = points.shape[1]
    # The square of the rounded radius, as in the kernel.
    near = ((centers[:, :, None] - points[:, None]) ** 2).sum(dim=-1) < points.new_tensor(radius) ** 2
    order = torch.arange(n_points, device=points.device).expand_as(near).masked_fill(~near, n_points)
    first = order.sort(dim=-1).values[..., :count]
    if n_points < count:
        lacking = first.new_full((*first.shape[:2], count - n_points), n_points)
        first = torch.cat([first, lacking], dim=-1)
    return first.where(first < n_points, first[..., :1]) % n_points


def gathered(values: Tensor, indices: Tensor) -> Tensor:
    """(B, C, ...) columns of (B, C, N) values by (B, ...) indices."""
    flat = indices.flatten(start_dim=1)[:, None].expand(-1, values.shape[1], -1)
    return values.gather(2, flat).reshape(*values.shape[:2], *indices.shape[1:])


def greatest(features: Tensor, groups: Tensor) -> Tensor:
    """(B, G, F) maxima of features (B, N, F) over groups (B, G, K) of indices.

    Only the greatest have a gradient, so that the large tensor of all members need not be kept.
    """
    count, size, width = features.shape
    first = size * torch.arange(count, device=groups.device)[:, None, None]
    members = (groups + first).reshape(-1, groups.shape[-1])
    rows = features.reshape(count * size, width)
    with torch.no_grad():
        around = rows.index_select(0, members.reshape(-1)).reshape(*members.shape, width)
        greatest_rows = members.gather(1, around.max(dim=1).indices)
    return rows.gather(0, greatest_rows).reshape(count, groups.shape[1], width)
