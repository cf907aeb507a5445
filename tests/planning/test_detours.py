"""Ways past things and round them."""

import numpy as np

from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import lowest
from handover_marl.planning.detours import detour, way_free
from handover_marl.planning.gripper_room import Balls
from tests.planning.robots import ARM, LIMITS

ARM_ = ArmInWorld(ARM, np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068]), LIMITS)
SPEEDS = np.full(7, 2.0)
START = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.785])
AWAY, TABLE, ROOM = Balls(np.array([[5.0, 5.0, 5.0]]), np.array([0.1])), 0.5, 0.01
# From one side to the other, about the first joint.
LEFT, RIGHT = (START + side * np.eye(7)[0] for side in (-0.7, 0.7))
NOTHING = np.zeros((0, 7))


def between() -> Balls:
    """A ball where the hand is half way."""
    return Balls(ARM_.hand(START)[None, :3], np.array([0.05]))


def free(joints: np.ndarray, goal: np.ndarray, bodies: Balls, table: float = TABLE) -> bool:
    return way_free(ARM_, joints, goal, bodies, table, ROOM)


def test_what_is_in_the_way_is_seen() -> None:
    assert free(LEFT, RIGHT, AWAY)
    assert not free(LEFT, RIGHT, between())
    assert free(LEFT, LEFT + 0.2 * (RIGHT - LEFT), between())


def test_a_table_is_in_the_way_too() -> None:
    down = START.copy()
    down[1] += 0.9
    height = float(lowest(ARM_, down[None])[0])
    assert height < float(lowest(ARM_, START[None])[0]) - 0.1
    assert free(START, down, AWAY, height - 0.02)
    assert not free(START, down, AWAY, height + 0.02)


def test_out_of_where_it_is_too_near_already_is_free() -> None:
    assert free(START, RIGHT, between())


def test_a_detour_leads_round_it() -> None:
    found = detour(ARM_, LEFT, RIGHT, NOTHING, SPEEDS, between(), TABLE, ROOM, 24)
    assert found is not None
    assert free(LEFT, found, between())
    assert free(found, RIGHT, between())
    low, high = ARM_.limits
    assert ((found >= low) & (found <= high)).all()


def test_the_soonest_of_the_known_ones_is_taken() -> None:
    """One that is known and on the way is sooner than any at random."""
    nothing = detour(ARM_, LEFT, RIGHT, START[None], SPEEDS, AWAY, TABLE, ROOM, 24)
    np.testing.assert_array_equal(nothing, START)


def test_there_may_be_none() -> None:
    """Whatever the way, the end of it is where something is."""
    there = Balls(ARM_.hand(RIGHT)[None, :3], np.array([0.05]))
    assert detour(ARM_, LEFT, RIGHT, START[None], SPEEDS, there, TABLE, ROOM, 24) is None
