"""Collisions of the open fingers with the visible part of an object on the way to a grasp."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig
from handover_marl.geometry.poses import compose

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FingerGeometry(CheckedConfig):
    """Geometry of the Panda's open fingers in the hand link's frame, with collision costs.

    The fingers close along y and approach along z.

    Attributes:
        inner_y: Distance of the fingers' inner sides from the middle between them (m).
        outer_y: Distance of the fingers' outer sides from the middle between them (m).
        half_width: Half of the fingers' width along x (m).
        tip_z: Position of the fingertips along z (m).
        lateral_shifts: Shifts of a grasp along y that are tried, the smallest first (m).
        shift_cost: Cost of shifting a grasp (s/m).
        collision_cost: Cost of the penetration depth that remains after the shift (s/m).
        free_depth: Penetration depth up to which a collision has no cost (m).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)
    any_length: ClassVar[frozenset[str]] = frozenset({"lateral_shifts"})

    inner_y: float = 0.039
    outer_y: float = 0.056
    half_width: float = 0.01
    tip_z: float = 0.112
    lateral_shifts: tuple[float, ...] = (0.0, -0.006, 0.006, -0.012, 0.012, -0.018, 0.018)
    shift_cost: float = 20.0
    collision_cost: float = 60.0
    free_depth: float = 0.003


def shift_to_avoid_collisions(
    grasps: Array, points: Array, fingers: FingerGeometry = FingerGeometry()
) -> tuple[Array, Array]:
    """Shift grasps (n, 7) sideways to minimize the depth of finger collisions, by as little as possible.

    Returns the shifted grasps, and the costs (n,) of shifts and remaining collisions (s) with points (k, 3) of the
    object.
    """
    rotations = Rotation.from_quat(grasps[:, 3:]).as_matrix() if len(grasps) else np.zeros((0, 3, 3))
    local = np.einsum("nkj,nji->nki", points[None] - grasps[:, None, :3], rotations)
    is_between, depth = np.abs(local[..., 0]) < fingers.half_width, fingers.tip_z - local[..., 2]
    depths = []
    for shift in fingers.lateral_shifts:
        lateral = np.abs(local[..., 1] - shift)
        is_hit = is_between & (lateral > fingers.inner_y) & (lateral < fingers.outer_y)
        depths.append(np.where(is_hit, depth, 0.0).max(axis=1, initial=0.0))
    best = np.argmin(np.round(np.stack(depths), 3), axis=0)
    shifts = np.array(fingers.lateral_shifts)[best]
    offsets = np.zeros((len(grasps), 7))
    offsets[:, 1], offsets[:, 6] = shifts, 1.0
    remaining = np.maximum(np.stack(depths)[best, np.arange(len(grasps))] - fingers.free_depth, 0.0)
    return compose(grasps, offsets), fingers.shift_cost * np.abs(shifts) + fingers.collision_cost * remaining
