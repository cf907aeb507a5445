"""Efficient evaluation of GA-DDPG's network on stored groups of points.

PointNet++ pads every group to a fixed size by repeating a point, which max pooling ignores. Of the
128 members of a group of groups, for example, at most 32 and usually 8 are distinct. This module
evaluates every distinct member once. In training, the statistics of batch normalization therefore
count every member once; with fixed statistics the output equals the output of PointNet++.
"""

import itertools

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.learning.imitation.gaddpg.batches import ImitationBatch
from handover_marl.learning.networks.gaddpg_network import ActorOutput, GaddpgNetwork
from handover_marl.learning.networks.point_encoders import PointNetPlusPlus, SetAbstraction


def evaluate_network(network: GaddpgNetwork, batch: ImitationBatch) -> ActorOutput:
    """Return the outputs of GA-DDPG's network for a batch of states, in the network's present mode.

    The mode (training or evaluation) determines the statistics of batch normalization.
    """
    output: ActorOutput = network.policy(_encode(network.features, batch), batch.remaining)
    return output


def _encode(encoder: PointNetPlusPlus, batch: ImitationBatch) -> Tensor:
    """Encode a batch as vectors (B, 512)."""
    first, second, last = (_shared_layers(stage) for stage in encoder.stages)
    points, centers = batch.points[batch.neighbors], batch.points[batch.centers]
    channels = points.new_zeros((len(points), encoder.n_channels - 3))
    relative = points - centers.repeat_interleave(batch.n_neighbors, dim=0)
    rows = torch.cat([relative, points, channels], dim=1)
    groups = _max_pool_rows(_apply_layers(first, rows), batch.n_neighbors)
    relative = centers[batch.center_neighbors] - centers.repeat_interleave(batch.n_center_neighbors, dim=0)
    rows = torch.cat([relative, groups[batch.center_neighbors]], dim=1)
    wide = _max_pool_rows(_apply_layers(second, rows), batch.n_center_neighbors)
    whole = _max_pool_rows(_apply_layers(last, torch.cat([centers, wide], dim=1)), batch.n_centers)
    vector: Tensor = encoder.dense(whole)
    return vector.float()


def _shared_layers(stage: nn.Module) -> nn.Sequential:
    layers = stage.mlps[0] if isinstance(stage, SetAbstraction) else stage
    if not isinstance(layers, nn.Sequential):
        raise TypeError(f"stage must be a SetAbstraction, got {type(stage).__name__}")
    return layers


def _apply_layers(layers: nn.Sequential, rows: Tensor) -> Tensor:
    """Apply convolutions of width 1 with batch normalization to rows (n, c)."""
    for convolution, norm in itertools.pairwise(layers):
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            rows = func.linear(rows, convolution.weight[:, :, 0, 0])
            rows = func.relu(_normalize_rows(norm, rows.float()))
    return rows


def _normalize_rows(norm: nn.BatchNorm2d, rows: Tensor) -> Tensor:
    momentum = 0.1 if norm.momentum is None else norm.momentum
    return func.batch_norm(
        rows, norm.running_mean, norm.running_var, norm.weight, norm.bias, norm.training, momentum, norm.eps
    )


def _max_pool_rows(rows: Tensor, counts: Tensor) -> Tensor:
    """Return the maxima (g, c) of consecutive groups of rows (n, c) with given sizes (g,)."""
    return torch.segment_reduce(rows.float(), "max", lengths=counts, unsafe=True)
