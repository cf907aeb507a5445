"""The nearer, the slower."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.planning.gripper_room import Balls, nearest
from handover_marl.planning.separation import Neighbour, SeparationConfig, separated

CONFIG = SeparationConfig()
HAND = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
# A hand with joints of its own: six that move it and turn it, one that does nothing.
JACOBIAN = np.concatenate([np.eye(6), np.zeros((6, 1))], axis=1)

vectors = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)


def beyond(room: float, least: float, moving: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Neighbour:
    """A ball so far before the fingers (z 0.1126)."""
    place = np.array([[0.0, 0.05, 0.1126 + room + 0.01]])
    return Neighbour(Balls(place, np.array([0.01])), np.array(moving), least)


@given(vectors, st.floats(0.005, 0.2))
def test_room_is_not_used_up_too_soon(velocity: np.ndarray, room: float) -> None:
    neighbour = beyond(room, 0.03)
    found = separated(velocity, HAND, JACOBIAN, [neighbour], CONFIG)
    near = nearest(HAND, neighbour.balls)
    point = found[:3] + np.cross(found[3:6], near.point - HAND[:3])
    allowed = min((0.03 - near.room) / CONFIG.time, CONFIG.flee)
    assert near.away @ point >= allowed - 2e-3


def test_what_is_slow_enough_stays_as_it_is() -> None:
    velocity = np.array([0.1, 0.2, 0.1, 0.0, 0.3, 0.0, 1.0])
    found = separated(velocity, HAND, JACOBIAN, [beyond(0.2, 0.03)], CONFIG)
    np.testing.assert_array_equal(found, velocity)


def test_a_coming_hand_counts() -> None:
    still, coming = beyond(0.05, 0.03), beyond(0.05, 0.03, (0.0, 0.0, -0.4))
    rest = np.zeros(7)
    np.testing.assert_array_equal(separated(rest, HAND, JACOBIAN, [still], CONFIG), rest)
    assert separated(rest, HAND, JACOBIAN, [coming], CONFIG)[2] < -0.1


def test_on_the_way_out_it_is_enough_to_come_no_nearer() -> None:
    sideways = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    narrow = beyond(0.01, 0.03)
    assert separated(sideways, HAND, JACOBIAN, [narrow], CONFIG)[2] < -0.05
    np.testing.assert_array_equal(separated(sideways, HAND, JACOBIAN, [narrow], CONFIG, leaving=True), sideways)
    onward = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    assert separated(onward, HAND, JACOBIAN, [narrow], CONFIG, leaving=True)[2] == pytest.approx(0.0, abs=0.02)
