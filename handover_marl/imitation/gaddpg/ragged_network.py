"""GA-DDPG's network on groups that were found before: the same function, without the work on repeats.

PointNet++ fills up every group with repeats of one point, which its maximum does not see: of 128 places in a group of
groups at most 32 are filled at all, mostly 8. Here each neighbour is looked at once. Statistics of batch
normalisation therefore count every neighbour once, in training; what is said with fixed statistics is the same.
"""

import itertools

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.imitation.gaddpg.batches import Batch
from handover_marl.networks.gaddpg_network import GaddpgNetwork
from handover_marl.networks.point_encoders import PointNetPlusPlus, SetAbstraction
from handover_marl.networks.policy_heads import Decision


def decide(network: GaddpgNetwork, batch: Batch) -> Decision:
    """What a network says of a batch; its mode decides which statistics are used."""
    decision: Decision = network.policy(encode(network.features, batch), batch.remaining)
    return decision


def encode(encoder: PointNetPlusPlus, batch: Batch) -> Tensor:
    """(B, 512) of a batch."""
    first, second, last = (_shared(stage) for stage in encoder.stages)
    near, places = batch.points[batch.near], batch.points[batch.centers]
    flag = near.new_zeros((len(near), encoder.n_channels - 3))
    away = near - places.repeat_interleave(batch.n_near, dim=0)
    groups = _largest(_layers(first, torch.cat([away, near, flag], dim=1)), batch.n_near)
    away = places[batch.beside] - places.repeat_interleave(batch.n_beside, dim=0)
    wide = _largest(_layers(second, torch.cat([away, groups[batch.beside]], dim=1)), batch.n_beside)
    whole = _largest(_layers(last, torch.cat([places, wide], dim=1)), batch.n_centers)
    vector: Tensor = encoder.dense(whole)
    return vector.float()


def _shared(stage: nn.Module) -> nn.Sequential:
    if not isinstance(stage, SetAbstraction):
        raise TypeError(f"{type(stage).__name__} is no set abstraction")
    layers = stage.mlps[0]
    if not isinstance(layers, nn.Sequential):
        raise TypeError(f"{type(layers).__name__} is no sequence of layers")
    return layers


def _layers(layers: nn.Sequential, rows: Tensor) -> Tensor:
    """Convolutions of width 1 and batch normalisation, on rows (n, c)."""
    for convolution, norm in itertools.pairwise(layers):
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            rows = func.linear(rows, convolution.weight[:, :, 0, 0])
            rows = func.relu(_normalised(norm, rows.float()))
    return rows


def _normalised(norm: nn.BatchNorm2d, rows: Tensor) -> Tensor:
    momentum = 0.1 if norm.momentum is None else norm.momentum
    return func.batch_norm(
        rows, norm.running_mean, norm.running_var, norm.weight, norm.bias, norm.training, momentum, norm.eps
    )


def _largest(rows: Tensor, counts: Tensor) -> Tensor:
    """(g, c) largest values of so many rows each."""
    return torch.segment_reduce(rows.float(), "max", lengths=counts, unsafe=True)
