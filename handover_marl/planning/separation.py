"""Keeping clear of what moves: the nearer, the slower.

The idea of speed and separation monitoring in ISO/TS 15066, as a velocity damper (Faverjon and Tournassoud, 1987): what
room there is beyond a least one may be used up within a given time and no sooner, the other body's own motion counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import nearest_rod
from handover_marl.planning.gripper_room import Balls, nearest

Array = npt.NDArray[np.float64]

_TINY = 1e-4
_ROUNDS = 4


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
    flee: float = 0.6


@dataclass(frozen=True, eq=False)
class Neighbour:
    """What to keep clear of: `balls`, the (3,) `velocity` of them (m/s), and the least `room` (m)."""

    balls: Balls
    velocity: Array
    room: float


def separated(
    velocity: Array,
    arm: ArmInWorld,
    joints: Array,
    neighbours: Sequence[Neighbour],
    config: SeparationConfig,
    leaving: bool = False,
) -> Array:
    """(7,) joint velocities (rad/s), changed as little as separation asks of gripper and forearm.

    Args:
        velocity: (7,) wanted (rad/s).
        arm: The arm.
        joints: (7,) where it is (rad).
        neighbours: What to keep clear of, what matters most last.
        config: How.
        leaving: Whether it is enough to come no nearer where there is too little room, since it is on its way out.
    """
    hand, dampers = arm.hand(joints), []
    for neighbour in neighbours:
        gripper = nearest(hand, neighbour.balls)
        for near, link in (nearest_rod(arm, joints, neighbour.balls), (gripper, arm.arm.n_joints)):
            room = min(neighbour.room, near.room) if leaving else neighbour.room
            least = min((room - near.room) / config.time, config.flee) + float(near.away @ neighbour.velocity)
            dampers.append((near.away @ arm.point_jacobian(joints, near.point, link), least))
    # What one asks for may undo what another asked for, so all are asked again.
    for row, least in _ROUNDS * dampers:
        rate = float(row @ velocity)
        if rate < least:
            velocity = velocity + row * (least - rate) / (row @ row + _TINY)
    return velocity
