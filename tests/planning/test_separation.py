"""The nearer, the slower."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.models.poses import compose_point
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import lowest, nearest_rod
from handover_marl.planning.gripper_room import Balls, nearest
from handover_marl.planning.separation import Neighbour, SeparationConfig, separated, slow_enough
from tests.planning.robots import ARM, LIMITS, START

CONFIG = SeparationConfig()
IN_WORLD = ArmInWorld(ARM, np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068]), LIMITS)
HAND = IN_WORLD.hand(START)

vectors = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)


def beyond(room: float, least: float, moving: float = 0.0) -> Neighbour:
    """A ball so far before a fingertip, that moves along the gripper's axis (m/s)."""
    place = compose_point(HAND, np.array([0.0, 0.05, 0.1126 + room + 0.01]))
    axis = compose_point(HAND, np.array([0.0, 0.0, 1.0])) - HAND[:3]
    return Neighbour(Balls(place[None], np.array([0.01])), moving * axis, least)


def coming_nearer(velocity: np.ndarray, neighbour: Neighbour) -> float:
    """How fast the room beside a ball shrinks (m/s), by small steps."""
    step = 1e-5
    rooms = [nearest(IN_WORLD.hand(START + time * velocity), neighbour.balls).room for time in (0.0, step)]
    return (rooms[0] - rooms[1]) / step


@given(vectors, st.floats(0.005, 0.2))
def test_room_is_not_used_up_too_soon(velocity: np.ndarray, room: float) -> None:
    neighbour = beyond(room, 0.03)
    found = separated(velocity, IN_WORLD, START, [neighbour], CONFIG)
    near = nearest(HAND, neighbour.balls).room
    assert coming_nearer(found, neighbour) <= max((near - 0.03) / CONFIG.time, -CONFIG.flee) + 5e-3


def test_what_is_slow_enough_stays_as_it_is() -> None:
    velocity = np.array([0.1, 0.1, 0.1, 0.0, 0.1, 0.0, 0.1])
    np.testing.assert_array_equal(separated(velocity, IN_WORLD, START, [beyond(0.3, 0.03)], CONFIG), velocity)


def test_a_coming_hand_counts() -> None:
    still, coming = beyond(0.05, 0.03), beyond(0.05, 0.03, -0.4)
    rest = np.zeros(7)
    np.testing.assert_array_equal(separated(rest, IN_WORLD, START, [still], CONFIG), rest)
    assert coming_nearer(separated(rest, IN_WORLD, START, [coming], CONFIG), coming) < -0.1


def test_on_the_way_out_it_is_enough_to_come_no_nearer() -> None:
    narrow, rest = beyond(0.01, 0.03), np.zeros(7)
    assert coming_nearer(separated(rest, IN_WORLD, START, [narrow], CONFIG), narrow) < -0.05
    np.testing.assert_array_equal(separated(rest, IN_WORLD, START, [narrow], CONFIG, leaving=True), rest)


def test_the_forearm_counts() -> None:
    origins, turns = IN_WORLD.frames(START[None])
    cover = origins[0, 4] + turns[0, 4] @ np.array([0.0, 0.16, -0.05])
    ball = Balls(cover[None], np.array([0.01]))
    before = nearest_rod(IN_WORLD, START, ball)[0].room
    assert before < 0.03
    found = separated(np.zeros(7), IN_WORLD, START, [Neighbour(ball, np.zeros(3), 0.03)], CONFIG)
    assert nearest_rod(IN_WORLD, START + 1e-3 * found, ball)[0].room > before


def test_one_neighbour_does_not_undo_what_another_asks_for() -> None:
    """A ball before a fingertip, another beside the cover of the forearm, both too near."""
    origins, turns = IN_WORLD.frames(START[None])
    cover = origins[0, 4] + turns[0, 4] @ np.array([0.0, 0.15, -0.05])
    neighbours = [Neighbour(Balls(cover[None], np.array([0.01])), np.zeros(3), 0.03), beyond(0.01, 0.03)]
    found = separated(np.array([0.5, 0.5, -0.5, 0.5, 0.5, 0.5, 0.5]), IN_WORLD, START, neighbours, CONFIG)
    assert coming_nearer(found, neighbours[1]) < 0.0
    before, after = (nearest_rod(IN_WORLD, q, neighbours[0].balls)[0].room for q in (START, START + 1e-5 * found))
    assert after > before


def test_the_first_that_is_slow_enough_is_taken() -> None:
    neighbour = beyond(0.05, 0.03)
    towards = np.linalg.pinv(IN_WORLD.jacobian(START)[:3]) @ (compose_point(HAND, np.array([0.0, 0.0, 1.0])) - HAND[:3])
    wanted = np.array([1.0, 0.5, 0.2, 0.0])[:, None] * towards

    def chosen(reached: np.ndarray) -> np.ndarray:
        return slow_enough(wanted, reached, IN_WORLD, START, [neighbour], 0.0, CONFIG)

    # 2 cm may be used up, and a little more, in the time that it looks ahead.
    found = coming_nearer(chosen(wanted), neighbour) * CONFIG.look
    assert 0.005 < found <= 0.02 + CONFIG.slack + 1e-3
    # What the motors make of it counts: where they cannot brake, the slowest is best.
    np.testing.assert_array_equal(chosen(np.repeat(wanted[:1], 4, axis=0)), wanted[0])
    np.testing.assert_array_equal(chosen(wanted[[0, 0, 0, 3]]), wanted[3])


def test_the_table_counts() -> None:
    joints, down = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.785]), np.eye(7)[1]
    height = float(lowest(IN_WORLD, joints[None])[0])
    wanted = np.array([1.0, 0.1, 0.0])[:, None] * down
    for table, expected in ((height - 0.2, 0), (height - CONFIG.table, 2)):
        found = slow_enough(wanted, wanted, IN_WORLD, joints, [], table, replace(CONFIG, slack=1e-4))
        np.testing.assert_array_equal(found, wanted[expected])
