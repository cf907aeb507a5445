"""Keeping clear of what moves: the nearer, the slower.

The idea of speed and separation monitoring in ISO/TS 15066, as a velocity damper (Faverjon and Tournassoud, 1987): what
room there is beyond a least one may be used up within a given time and no sooner, the other body's own motion counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import lowest, nearest_rod, rod_rooms
from handover_marl.planning.gripper_room import Balls, nearest, open_rooms

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
        table: Likewise above the table (m).
        time: Time in which the room beyond that may be used up (s), and
        last_time: while it closes in on a grasp (s).
        flee: Speed at most with which it gives way when the room is less (m/s).
        look: The room is foreseen for this time (s), since what passes by at speed comes near all at once, and
        slack: may then be less by so much (m), before it goes slower.
    """

    stop: float = 0.03
    object_stop: float = 0.015
    touch: float = 0.003
    table: float = 0.01
    time: float = 0.15
    last_time: float = 0.05
    flee: float = 0.6
    look: float = 0.06
    slack: float = 0.003


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


def slow_enough(
    wanted: Array,
    reached: Array,
    arm: ArmInWorld,
    joints: Array,
    neighbours: Sequence[Neighbour],
    table: float,
    config: SeparationConfig,
) -> Array:
    """(7,) the first of some joint velocities with which nothing comes too near within a short time.

    If there is none, the one with which it comes least too near.

    Args:
        wanted: (n, 7) velocities to choose from, the best first (rad/s).
        reached: (n, 7) what the motors make of them (rad/s).
        arm: The arm.
        joints: (7,) where it is (rad).
        neighbours: What to keep clear of, besides
        table: a table of this height (m).
        config: How.
    """
    line = np.concatenate([joints[None], joints + config.look * reached])
    hands, heights = arm.hands(line), lowest(arm, line) - table
    lacks = np.maximum(0.0, min(config.table, float(heights[0])) - config.slack - heights[1:])
    for neighbour in neighbours:
        balls = neighbour.balls
        soon = Balls(balls.centers + config.look * neighbour.velocity, balls.radii)
        now = min(float(open_rooms(hands[:1], balls)[0]), float(rod_rooms(arm, line[:1], balls)[0]))
        rooms = np.minimum(open_rooms(hands[1:], soon), rod_rooms(arm, line[1:], soon))
        lacks = np.maximum(lacks, min(neighbour.room, now) - config.slack - rooms)
    return np.asarray(wanted[int(np.argmin(lacks))])
