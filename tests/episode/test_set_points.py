import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.config import TIME_STEP
from handover_marl.episode.wrist_offset import track_set_points

components = st.floats(-0.5, 0.5)
SPEED, ACCELERATION = 0.8, 5.0
LIMITS = np.array([[SPEED, 2.5], [ACCELERATION, 15.0]])


def track(*targets: tuple[npt.ArrayLike, int]) -> np.ndarray:
    """Return the values (n, 3) while several set points are tracked in turn."""
    value, velocity, parts = np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), [np.zeros((0, 3))]
    for set_point, steps in targets:
        goals = np.tile(np.array(set_point, dtype=float), (1, 2, 1))
        values, velocities = track_set_points(value, velocity, goals, steps, LIMITS)
        value, velocity = values[:, -1], velocities[:, -1]
        parts.append(values[0, :, 0])
    return np.concatenate(parts)


@pytest.mark.slow
@given(st.lists(st.tuples(st.tuples(components, components, components), st.integers(1, 300)), max_size=4))
def test_speed_and_acceleration_are_limited(targets: list[tuple[tuple[float, float, float], int]]) -> None:
    values = np.concatenate([np.zeros((2, 3)), track(*targets)])
    velocity = np.diff(values, axis=0) / TIME_STEP
    assert np.linalg.norm(velocity, axis=1).max(initial=0.0) <= SPEED + 1e-9
    # On arrival, the value is set to the goal, a change of less than a micrometre.
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / TIME_STEP
    assert acceleration.max(initial=0.0) <= ACCELERATION + 1.1


@pytest.mark.slow
@given(st.tuples(components, components, components))
def test_the_set_point_is_reached_exactly_and_kept(goal: tuple[float, float, float]) -> None:
    np.testing.assert_array_equal(track((goal, 2500))[-200:], np.tile(goal, (200, 1)))


def test_there_is_no_overshoot() -> None:
    values = track(([0.2, 0.0, 0.0], 1000))
    assert values[:, 0].max() <= 0.2 + 2e-6
    assert values[-1, 0] == 0.2


def test_the_number_of_steps_per_call_does_not_matter() -> None:
    goal = [0.1, -0.2, 0.05]
    np.testing.assert_array_equal(track((goal, 300)), track(*((goal, n) for n in (1, 99, 7, 193))))


def test_an_offset_that_passes_its_set_point_returns() -> None:
    value, velocity = np.array([[[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]]), np.array([[[0.5, 0.0, 0.0], [0.0, 0.0, -1.0]]])
    path, speeds = track_set_points(value, velocity, value, 1000, LIMITS)
    assert np.abs(path - value[:, None]).max() > 0.01
    np.testing.assert_array_equal(path[:, -1], value)
    assert not speeds[:, -1].any()
