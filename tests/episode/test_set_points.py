import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.config import TIME_STEP
from handover_marl.episode.set_points import SetPoint

components = st.floats(-0.5, 0.5)
SPEED, ACCELERATION = 0.8, 5.0


def new() -> SetPoint:
    return SetPoint(SPEED, ACCELERATION)


@given(st.lists(st.tuples(st.tuples(components, components, components), st.integers(1, 300)), max_size=4))
def test_limits_hold_whatever_is_wanted(wishes: list[tuple[tuple[float, float, float], int]]) -> None:
    point = new()
    way = np.concatenate([np.zeros((2, 3)), *(point.approach(goal, steps) for goal, steps in wishes)])
    velocity = np.diff(way, axis=0) / TIME_STEP
    assert np.linalg.norm(velocity, axis=1).max(initial=0.0) <= SPEED + 1e-9
    # Arriving snaps to the goal, which takes less than a micrometre.
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / TIME_STEP
    assert acceleration.max(initial=0.0) <= ACCELERATION + 1.1


@given(st.tuples(components, components, components))
def test_it_arrives_exactly_and_stays(goal: tuple[float, float, float]) -> None:
    point = new()
    way = point.approach(goal, 2500)
    np.testing.assert_array_equal(way[-200:], np.tile(goal, (200, 1)))


def test_it_does_not_overshoot() -> None:
    way = new().approach([0.2, 0.0, 0.0], 1000)
    assert way[:, 0].max() <= 0.2 + 2e-6
    assert way[-1, 0] == 0.2


def test_how_steps_are_cut_does_not_matter() -> None:
    whole, cut = new(), new()
    parts = [cut.approach([0.1, -0.2, 0.05], n) for n in (1, 99, 7, 193)]
    np.testing.assert_array_equal(whole.approach([0.1, -0.2, 0.05], 300), np.concatenate(parts))
