"""Straight ways of the joints past things, and ways round what is in them."""

import numpy as np
import numpy.typing as npt

from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import lowest, rod_rooms
from handover_marl.planning.gripper_room import Balls, open_rooms

Array = npt.NDArray[np.float64]

# Of a straight way, where it is looked whether something is in it.
_SHARES = np.array([0.25, 0.5, 0.75, 1.0])
# From the middle of a way (rad).
_ASIDE = np.random.default_rng(0).normal(0.0, 0.6, (50, 7))
_BATCH = 6
_SAME = 1e-9


def way_free(arm: ArmInWorld, joints: Array, goal: Array, bodies: Balls, table: float, room: float) -> bool:
    """Whether arm and open gripper come straight from joints (7,) to others, or at least no nearer than they are.

    Args:
        arm: The arm.
        joints: Where it is (rad).
        goal: Where it is to be (rad).
        bodies: What it must keep clear of, besides
        table: a table of this height (m),
        room: by so much (m).
    """
    way = joints + _SHARES[:, None] * (goal - joints)
    return bool(_free(arm, joints, way[None], bodies, table, room)[0])


def detour(
    arm: ArmInWorld,
    joints: Array,
    goal: Array,
    known: Array,
    speeds: Array,
    bodies: Balls,
    table: float,
    room: float,
    looks: int,
) -> Array | None:
    """(7,) joints by way of which a goal is reached on two free straight ways, soonest of those looked at, or None.

    Args:
        arm: The arm.
        joints: (7,) where it is (rad).
        goal: (7,) where it is to be (rad).
        known: (n, 7) joints to look at besides some about the middle of the way (rad).
        speeds: (7,) of the joints (rad/s).
        bodies: What it must keep clear of, besides
        table: a table of this height (m),
        room: by so much (m).
        looks: So many are looked at, the soonest ones first.
    """
    middles = np.clip(np.concatenate([known, 0.5 * (joints + goal) + _ASIDE]), *arm.limits)
    time = (np.abs(middles - joints) / speeds).max(axis=1) + (np.abs(middles - goal) / speeds).max(axis=1)
    soonest = middles[np.argsort(time, kind="stable")[:looks]]
    shares = _SHARES[:, None, None]
    for some in np.split(soonest, range(_BATCH, len(soonest), _BATCH)):
        ways = np.concatenate([joints + shares * (some - joints), some + shares * (goal - some)]).swapaxes(0, 1)
        free = _free(arm, joints, ways, bodies, table, room)
        if free.any():
            return np.asarray(some[int(np.argmax(free))])
    return None


def _free(
    arm: ArmInWorld, joints: Array, ways: Array, bodies: Balls, table: float, room: float
) -> npt.NDArray[np.bool_]:
    """(n,) whether ways (n, k, 7) from the arm at (7,) keep clear of bodies, or go no nearer than it is."""
    line = np.concatenate([joints[None], ways.reshape(-1, ways.shape[-1])])
    rooms = np.minimum(rod_rooms(arm, line, bodies), open_rooms(arm.hands(line), bodies))
    rooms = np.minimum(rooms, lowest(arm, line) - table)
    enough = rooms[1:] >= min(float(rooms[0]), room) - _SAME
    return np.asarray(enough.reshape(ways.shape[:2]).all(axis=1))
