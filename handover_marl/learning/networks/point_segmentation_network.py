"""Network that separates the points of the object from those of the person's hand that holds it.

As in PointNet++ for segmentation (Qi et al., NeurIPS 2017), it computes features of neighborhoods that grow from level
to level, and interpolates them back to the points. Unlike in an image, a hand has the same size at any distance.
"""

import itertools

import torch
import torch.nn.functional as func
from torch import Tensor, nn

#: Number of points in a cloud, of which the first ones, in random order, are the centers of neighborhoods.
N_BODY_POINTS = 256
_N_COARSE, _N_COARSEST = 96, 32
# Numbers of nearest points in a neighborhood of each level, and factors of distances in them (1/m).
_FINE_SIZE, _COARSE_SIZE, _COARSEST_SIZE = 12, 20, 12
_FINE_SCALE, _COARSE_SCALE, _COARSEST_SCALE = 30.0, 20.0, 10.0
# Factors of positions in the cloud and of the view (1/m), and largest difference of logits that counts.
_CLOUD_SCALE, _VIEW_SCALE, _MAX_MARGIN = 10.0, 2.0, 4.0
_N_INTERPOLATED = 3
_FINE, _COARSE, _COARSEST = 64, 128, 192  # numbers of features at the points of each level


def _layers(*widths: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after), nn.LayerNorm(after), nn.ReLU()]
    return nn.Sequential(*layers)


def _gather(values: Tensor, indices: Tensor) -> Tensor:
    """Return the rows of values (B, N, C) at indices (B, M, K), as (B, M, K, C)."""
    flat = indices.flatten(start_dim=1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).reshape(*indices.shape, -1)


def _find_nearest(points: Tensor, centers: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return distances (B, M, count) and indices of the points (B, N, 3) that are nearest to centers (B, M, 3)."""
    nearest: tuple[Tensor, Tensor] = torch.cdist(centers, points).topk(count, largest=False)
    return nearest


class _Neighborhoods(nn.Module):
    """Layer that computes features of each center: maxima of features of its `size` nearest points.

    The features of a point depend on its position relative to the center, which is multiplied by `scale` (1/m).
    """

    def __init__(self, n_inputs: int, n_outputs: int, size: int, scale: float) -> None:
        super().__init__()
        self.size, self.scale = size, scale
        # Linear in relative positions, so that each point is encoded only once.
        self.inner, self.relative = nn.Linear(n_inputs, n_outputs), nn.Linear(3, n_outputs)
        self.outer = _layers(n_outputs, n_outputs)

    def forward(self, points: Tensor, features: Tensor, centers: Tensor) -> Tensor:
        """Return features (B, M, n_outputs) of centers (B, M, 3) from features (B, N, n_inputs) of points (B, N, 3)."""
        near = _find_nearest(points, centers, self.size)[1]
        relative = self.scale * (_gather(points, near) - centers[:, :, None])
        found: Tensor = self.outer(func.relu(_gather(self.inner(features), near) + self.relative(relative)).amax(dim=2))
        return found


def _interpolate(points: Tensor, centers: Tensor, features: Tensor) -> Tensor:
    """Return features (B, N, C) of points (B, N, 3) from features (B, M, C) of the three nearest centers (B, M, 3)."""
    distances, near = _find_nearest(centers, points, _N_INTERPOLATED)
    weights = 1.0 / (distances + 1e-3)
    weights = weights / weights.sum(dim=-1, keepdim=True)
    return (_gather(features, near) * weights[..., None]).sum(dim=2)


class PointSegmentationNetwork(nn.Module):
    """Network that assigns each point of clouds of object and hand to one of `n_classes` classes."""

    def __init__(self, n_classes: int) -> None:
        super().__init__()
        self.shape = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, _FINE))
        self.point = _layers(_FINE + 4, _FINE)
        self.coarse = _Neighborhoods(_FINE, _COARSE, _COARSE_SIZE, _COARSE_SCALE)
        self.coarsest = _Neighborhoods(_COARSE, _COARSEST, _COARSEST_SIZE, _COARSEST_SCALE)
        self.cloud = _layers(_COARSEST + 4, _COARSEST)
        self.up = nn.ModuleList(
            [
                _layers(2 * _COARSEST, _COARSEST),
                _layers(_COARSEST + _COARSE, _COARSE),
                _layers(_COARSE + _FINE + 3, 96, _FINE),
            ]
        )
        self.head = nn.Linear(_FINE, n_classes)

    def forward(self, points: Tensor, margins: Tensor, hand_link: Tensor) -> Tensor:
        """Return the logits (B, N, n_classes) of the points of B clouds.

        Args:
            points: (B, N, 3) points in a frame whose z coordinate is the height in the world (m), in random order.
            margins: (B, N) logit of the hand minus logit of the object that the image network predicts; 0 if unknown.
            hand_link: (B, 3) position of the robot's hand link in the same frame (m).
        """
        mean = points.mean(dim=1)
        local = points - mean[:, None]
        view = _VIEW_SCALE * torch.cat([hand_link - mean, mean[:, 2:]], dim=-1)
        near = _find_nearest(local, local, _FINE_SIZE)[1]
        shape = self.shape(_FINE_SCALE * (_gather(local, near) - local[:, :, None])).amax(dim=2)
        known = margins.clamp(-_MAX_MARGIN, _MAX_MARGIN)[..., None] / 2.0
        fine = self.point(torch.cat([shape, _CLOUD_SCALE * local, known], dim=-1))
        centers, far_centers = local[:, :_N_COARSE], local[:, :_N_COARSEST]
        coarse = self.coarse(local, fine, centers)
        coarsest = self.coarsest(centers, coarse, far_centers)
        cloud = self.cloud(torch.cat([coarsest.amax(dim=1), view], dim=-1))
        found = self.up[0](torch.cat([coarsest, cloud[:, None].expand_as(coarsest)], dim=-1))
        found = self.up[1](torch.cat([_interpolate(centers, far_centers, found), coarse], dim=-1))
        found = self.up[2](torch.cat([_interpolate(local, centers, found), fine, _CLOUD_SCALE * local], dim=-1))
        logits: Tensor = self.head(found)
        return logits
