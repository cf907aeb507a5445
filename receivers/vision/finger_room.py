"""Whether open fingers pass what is seen of an object on their straight way to a grasp, or would if moved aside."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import compose

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Fingers:
    """The Panda's open fingers in the hand link's frame, which close along y and come along z.

    Attributes:
        inner: Where they begin beside the middle, and
        outer: where they end (m).
        half: Half their breadth along x (m).
        tip: Where they end along z (m).
        asides: Moves along y that are tried where they do not pass (m), the least first.
        moving: Price of a move (s/m), and of
        hitting: how far the object reaches into a finger's way (s/m), beyond
        slight: this (m).
    """

    inner: float = 0.039
    outer: float = 0.056
    half: float = 0.01
    tip: float = 0.112
    asides: tuple[float, ...] = (0.0, -0.006, 0.006, -0.012, 0.012, -0.018, 0.018)
    moving: float = 20.0
    hitting: float = 60.0
    slight: float = 0.003


def passing(grasps: Array, points: Array, fingers: Fingers = Fingers()) -> tuple[Array, Array]:
    """Grasps moved aside as little as lets the fingers pass, or where they come deepest.

    Args:
        grasps: (n, 7) poses of the hand link.
        points: (k, 3) of the object, in the same frame.
        fingers: They.

    Returns:
        The grasps (n, 7), and the prices (n,) of what they were moved, and of what is still in the fingers' ways (s).
    """
    local = _seen_from(grasps, points)
    across, along = np.abs(local[..., 0]) < fingers.half, fingers.tip - local[..., 2]
    depths = []
    for aside in fingers.asides:
        beside = np.abs(local[..., 1] - aside)
        inside = across & (beside > fingers.inner) & (beside < fingers.outer)
        depths.append(np.where(inside, along, 0.0).max(axis=1, initial=0.0))
    least = np.argmin(np.round(np.stack(depths), 3), axis=0)
    moved = np.array(fingers.asides)[least]
    ways = np.zeros((len(grasps), 7))
    ways[:, 1], ways[:, 6] = moved, 1.0
    left = np.maximum(np.stack(depths)[least, np.arange(len(grasps))] - fingers.slight, 0.0)
    return compose(grasps, ways), fingers.moving * np.abs(moved) + fingers.hitting * left


def _seen_from(poses: Array, points: Array) -> Array:
    """(n, k, 3) points (k, 3) in the frames of poses (n, 7)."""
    turns = Rotation.from_quat(poses[:, 3:]).as_matrix() if len(poses) else np.zeros((0, 3, 3))
    away = points[None] - poses[:, None, :3]
    seen: Array = np.einsum("nkj,nji->nki", away, turns)
    return seen
