"""Keeping clear of what moves: the nearer, the slower.

The idea of speed and separation monitoring in ISO/TS 15066, as a velocity damper (Faverjon and Tournassoud, 1987): what
room there is beyond a least one may be used up within a given time and no sooner, the other body's own motion counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.planning.gripper_room import Balls, nearest

Array = npt.NDArray[np.float64]

_TINY = 1e-4


@dataclass(frozen=True)
class SeparationConfig:
    """How near the gripper comes, and how fast.

    Attributes:
        stop: Room beside the person's hand below which the gripper does not come nearer (m), and
        object_stop: beside the object, on the way to a standoff.
        touch: Likewise beside the hand, while it closes in on a grasp, which has room (m).
        time: Time in which the room beyond that may be used up (s), and
        last_time: while it closes in on a grasp (s).
        flee: Speed at most with which it gives way when the room is less (m/s).
    """

    stop: float = 0.03
    object_stop: float = 0.015
    touch: float = 0.003
    time: float = 0.15
    last_time: float = 0.05
    flee: float = 0.3


@dataclass(frozen=True, eq=False)
class Neighbour:
    """What to keep clear of: `balls`, the (3,) `velocity` of them (m/s), and the least `room` (m)."""

    balls: Balls
    velocity: Array
    room: float


def separated(
    velocity: Array,
    hand: Array,
    jacobian: Array,
    neighbours: Sequence[Neighbour],
    config: SeparationConfig,
    leaving: bool = False,
) -> Array:
    """(7,) joint velocities (rad/s), changed as little as separation asks.

    Args:
        velocity: (7,) wanted (rad/s).
        hand: (7,) pose of the hand link.
        jacobian: (6, 7) of the hand link.
        neighbours: What to keep clear of, what matters most last.
        config: How.
        leaving: Whether it is enough to come no nearer where there is too little room, since it is on its way out.
    """
    for neighbour in neighbours:
        near = nearest(hand, neighbour.balls)
        lever = near.point - hand[:3]
        row = near.away @ jacobian[:3] + np.cross(lever, near.away) @ jacobian[3:]
        rate = float(row @ velocity - near.away @ neighbour.velocity)
        room = min(neighbour.room, near.room) if leaving else neighbour.room
        least = min((room - near.room) / config.time, config.flee)
        if rate < least:
            velocity = velocity + row * (least - rate) / (row @ row + _TINY)
    return velocity
