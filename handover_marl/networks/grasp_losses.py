"""How far what a grasp network tells is from grasps that are good there."""

from typing import NamedTuple

import torch
import torch.nn.functional as func
from torch import Tensor

from handover_marl.networks.grasp_network import PADS, Grasps

# Two points of the fingers, so far from the middle between the pads, tell turns about the approach (m).
_FINGER = 0.04
# A point of the object belongs to a grasp if the gripper's pads close over it: half sizes of the place (m).
_OVER = (0.015, 0.045, 0.025)
# A grasp of quality 1 is worth another this much nearer (m), and one this far off half of nothing.
_PREFERENCE, _OFF = 0.03, 0.02


class GoodGrasps(NamedTuple):
    """K grasps for each of B views, in its frame.

    Attributes:
        places: (B, K, 3) middles between the pads (m).
        turns: (B, K, 3, 3) of the hand link.
        quality: (B, K) from 0, which is none, to 1.
    """

    places: Tensor
    turns: Tensor
    quality: Tensor


class Losses(NamedTuple):
    """Means over a batch.

    Attributes:
        grasp: Distance of grasps told to the good ones that they belong to (m).
        quality: Cross entropy of how good they are.
        middle: Distance of the object's middle (m).
        motion: Of its coming motion (m).
    """

    grasp: Tensor
    quality: Tensor
    middle: Tensor
    motion: Tensor


def good_grasps(poses: Tensor, quality: Tensor) -> GoodGrasps:
    """From poses (B, K, 7) of the hand link, quaternions xyzw, and qualities (B, K)."""
    x, y, z, w = func.normalize(poses[..., 3:], dim=-1).unbind(dim=-1)
    across = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1)
    ahead = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1)
    turns = torch.stack([torch.linalg.cross(across, ahead, dim=-1), across, ahead], dim=-1)
    return GoodGrasps(poses[..., :3] + PADS * ahead, turns, quality)


def distances(found: Grasps, good: GoodGrasps) -> Tensor:
    """(B, C, K) mean distances (m) of points of the gripper between grasps told and good ones; half turns are equal."""
    place, at = found.places[:, :, None], good.places[:, None]
    back = place - PADS * found.turns[:, :, None, :, 2] - (at - PADS * good.turns[:, None, :, :, 2])
    finger, other = _FINGER * found.turns[:, :, None, :, 1], _FINGER * good.turns[:, None, :, :, 1]
    away = place - at
    one = (away + finger - other).norm(dim=-1) + (away - finger + other).norm(dim=-1)
    half = (away + finger + other).norm(dim=-1) + (away - finger - other).norm(dim=-1)
    total: Tensor = (back.norm(dim=-1) + torch.minimum(one, half)) / 3.0
    return total


def belongs(centers: Tensor, good: GoodGrasps) -> Tensor:
    """(B, C, K) whether the pads of good grasps close over points (B, C, 3) of the object."""
    local = torch.einsum("bcki,bkij->bckj", centers[:, :, None] - good.places[:, None], good.turns)
    inside = (local.abs() < local.new_tensor(_OVER)).all(dim=-1)
    return inside & (good.quality > 0.0)[:, None]


def losses(found: Grasps, centers: Tensor, good: GoodGrasps, middle: Tensor, motion: Tensor) -> Losses:
    """Losses of a batch.

    Args:
        found: What the network tells.
        centers: (B, C, 3) where (m).
        good: What is good.
        middle: (B, 3) of the object (m).
        motion: (B, 3) its coming motion (m).
    """
    with torch.no_grad():
        away = distances(found, good)
        price = away - _PREFERENCE * good.quality[:, None]
        nearest = price.masked_fill(~belongs(centers, good), torch.inf).min(dim=-1)
        worth = (good.quality[:, None] * torch.exp(-((away / _OFF) ** 2))).amax(dim=-1)
    there = torch.isfinite(nearest.values)
    chosen = GoodGrasps(
        good.places.gather(1, nearest.indices[..., None].expand(-1, -1, 3)),
        good.turns.gather(1, nearest.indices[..., None, None].expand(-1, -1, 3, 3)),
        good.quality,
    )
    own = _one_to_one(found, chosen)
    return Losses(
        (own * there).sum() / there.sum().clamp(min=1),
        func.binary_cross_entropy_with_logits(found.quality, worth),
        (found.middle - middle).norm(dim=-1).mean(),
        (found.motion - motion).norm(dim=-1).mean(),
    )


def _one_to_one(found: Grasps, good: GoodGrasps) -> Tensor:
    """(B, C) distances of grasps told to as many good ones."""
    count = found.places.shape[0] * found.places.shape[1]
    flat = Grasps(
        found.quality.reshape(count, 1),
        found.places.reshape(count, 1, 3),
        found.turns.reshape(count, 1, 3, 3),
        found.middle,
        found.motion,
    )
    single = GoodGrasps(good.places.reshape(count, 1, 3), good.turns.reshape(count, 1, 3, 3), good.quality)
    return distances(flat, single).reshape(found.quality.shape)
