"""Elbow, forearm and wrist of a Panda as rods: lines with a radius, which balls keep clear of."""

import numpy as np
import numpy.typing as npt

from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.gripper_room import Balls, Nearest, corners

Array = npt.NDArray[np.float64]

#: Number of the turning link, both ends in its frame and radius (m) of each rod. They cover the hulls of the collision
#: meshes of links 4 to 6, with which the engine collides, to within 1.6 cm; the forearm's hull is much wider on
#: the side of its cover than on the others.
RODS = (
    (3, (0.0, 0.0, 0.045), (-0.08, 0.07, 0.0), 0.06),
    (3, (-0.082, 0.0, 0.0), (-0.082, 0.082, 0.0), 0.055),
    (3, (-0.04, 0.08, 0.0), (-0.085, 0.082, 0.0), 0.053),
    (4, (0.0, 0.0, -0.215), (0.0, 0.0, -0.005), 0.055),
    (4, (0.0, 0.035, -0.195), (0.0, 0.08, -0.01), 0.053),
    (4, (0.0, 0.0, -0.215), (0.0, 0.04, -0.195), 0.053),
    (4, (0.0, 0.04, -0.04), (0.0, 0.075, 0.0), 0.053),
    (5, (0.0, 0.0, 0.0), (0.088, 0.0, 0.0), 0.055),
    (5, (0.02, 0.01, 0.0), (0.085, 0.032, 0.0), 0.053),
)

_LINKS = np.array([link for link, *_ in RODS])
_STARTS, _ENDS = (np.array([rod[end] for rod in RODS]) for end in (1, 2))
_RADII = np.array([rod[3] for rod in RODS])
_TINY = 1e-9


def rod_rooms(arm: ArmInWorld, joints: Array, balls: Balls) -> Array:
    """(n,) distances (m) between balls and the arm at configurations (n, 7), negative inside."""
    starts, ends = _rods(arm, joints)
    points = balls.centers.T
    axes = ends - starts
    # Scalar products of ways from a start to a ball, without the ways themselves: this is done for many at once.
    along = axes @ points - (axes * starts).sum(axis=-1)[..., None]
    squared = (axes**2).sum(axis=-1)[..., None]
    share = np.clip(along / np.maximum(squared, _TINY), 0.0, 1.0)
    away = (starts**2).sum(axis=-1)[..., None] - 2.0 * (starts @ points) + (points**2).sum(axis=0)
    distances = np.sqrt(np.maximum(away - share * (2.0 * along - share * squared), 0.0))
    found: Array = (distances - balls.radii - _RADII[:, None]).min(axis=(1, 2))
    return found


def lowest(arm: ArmInWorld, joints: Array) -> Array:
    """(n,) heights (m) of the lowest points of arm and open gripper at configurations (n, 7)."""
    starts, ends = _rods(arm, joints)
    rods = (np.minimum(starts[..., 2], ends[..., 2]) - _RADII).min(axis=1)
    found: Array = np.minimum(rods, corners(arm.hands(joints))[..., 2].min(axis=1))
    return found


def nearest_rod(arm: ArmInWorld, joints: Array, balls: Balls) -> tuple[Nearest, int]:
    """The nearest points of the arm at one configuration (7,) and of balls, and the number of the turning link."""
    starts, ends = (end[0] for end in _rods(arm, joints[None]))
    axes = (ends - starts)[:, None]
    away = balls.centers - starts[:, None]
    along = (away * axes).sum(axis=-1) / np.maximum((axes**2).sum(axis=-1), _TINY)
    feet = starts[:, None] + np.clip(along, 0.0, 1.0)[..., None] * axes
    apart = feet - balls.centers
    lengths = np.linalg.norm(apart, axis=-1)
    distances = lengths - balls.radii - _RADII[:, None]
    rod, ball = np.unravel_index(int(np.argmin(distances)), distances.shape)
    unit = apart[rod, ball] / max(float(lengths[rod, ball]), _TINY)
    near = Nearest(float(distances[rod, ball]), feet[rod, ball] - _RADII[rod] * unit, unit, int(ball))
    return near, int(_LINKS[rod])


def _rods(arm: ArmInWorld, joints: Array) -> tuple[Array, Array]:
    """(n, rods, 3) starts and ends in the world (m)."""
    origins, turns = arm.frames(joints)
    own_origins, own_turns = origins[:, _LINKS], turns[:, _LINKS]
    starts, ends = ((own_turns @ local[..., None])[..., 0] + own_origins for local in (_STARTS, _ENDS))
    return starts, ends
