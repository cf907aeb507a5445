"""Where the pads of a closing gripper meet an object: well on them, or by a tip or an edge, from which it springs away.

When the person lets go, what is held by the fingers' very tips is squeezed out by them within a few hundredths of a
second, though its grasp stood its trials.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.models.poses import inverse_transform_points
from handover_marl.planning.gripper_room import Balls
from handover_marl.receivers.reactive.grasps import TriedGrasps
from handover_marl.receivers.reactive.reactive_config import GraspCosts

Array = npt.NDArray[np.float64]

# The fingers' ends and half their width in the hand link's frame, where they begin, and how far apart they open (m).
_TIP, _HALF_WIDTH, _ROOT, _OPEN = 0.1126, 0.0105, 0.058, 0.041
# Points of the surface so near to the first that a pad meets are met too (m).
_SOFT = 0.0015


@dataclass(frozen=True, eq=False)
class Graspable:
    """An object to be grasped, all in its own frame.

    Attributes:
        tried: Its grasps.
        grips: (n,) how well on the pads they have it (m), see `grips`.
        surface: It, as few balls.
        points: (k, 3) on it, many (m).
    """

    tried: TriedGrasps
    grips: Array
    surface: Balls
    points: Array


def spread_points(vertices: Array, faces: npt.NDArray[np.int_], count: int) -> Array:
    """(k, 3) the vertices of a mesh and `count` points at random over its surface; always the same ones (m)."""
    rng = np.random.default_rng(0)
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(faces), count, p=areas / areas.sum())]
    found: Array = np.concatenate([vertices, np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), count), chosen)])
    return found


def grips(poses: Array, points: Array) -> Array:
    """(n,) how far from tip and edges the worse of two pads meets a surface (m), 0 where one meets nothing.

    The distance from an edge counts twice, since fingers are thin.

    Args:
        poses: (n, 7) of the hand link, in the frame of the points.
        points: (k, 3) on the surface (m).
    """
    found = np.zeros(len(poses))
    for number, pose in enumerate(poses):
        local = inverse_transform_points(pose, points)
        x, y, z = np.abs(local[:, 0]), local[:, 1], local[:, 2]
        met = (x < _HALF_WIDTH) & (np.abs(y) < _OPEN) & (z > _ROOT) & (z < _TIP)
        if met.any():
            inside = np.minimum(_TIP - z[met], 2.0 * (_HALF_WIDTH - x[met]))
            found[number] = min(inside[side > side.max() - _SOFT].max() for side in (y[met], -y[met]))
    return found


def looseness(tried: TriedGrasps, inside: Array, costs: GraspCosts) -> Array:
    """(n,) prices (s) of how loosely grasps hold.

    Args:
        tried: How they stood their trials.
        inside: (n,) how well on the pads they have the object (m), see `grips`.
        costs: Prices.
    """
    price: Array = costs.unstable * (tried.holds == 0.0) + costs.shaky * (1.0 - tried.holds)
    price += costs.tips * np.maximum(0.0, 1.0 - inside / costs.inside)
    return price
