"""Where an object will be held out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.planning.offer_prediction import OfferConfig, OfferPrediction

STEP = 0.05


def pose(place: np.ndarray, turn: float = 0.0) -> np.ndarray:
    return np.concatenate([place, Rotation.from_euler("z", turn).as_quat()])


def followed(speed: float, seconds: float = 1.0, turning: float = 0.0) -> OfferPrediction:
    prediction = OfferPrediction(OfferConfig())
    for number in range(round(seconds / STEP) + 1):
        time = number * STEP
        prediction.see(time, pose(np.array([0.5, speed * time, 1.0]), turning * time))
    return prediction


def test_what_rests_is_offered_where_it_is() -> None:
    prediction = followed(0.0)
    np.testing.assert_allclose(prediction.offered(), pose(np.array([0.5, 0.0, 1.0])), atol=1e-12)
    assert prediction.rest == pytest.approx(1.0)
    assert prediction.lifted == 0.0


def test_velocity_is_that_of_a_steady_motion() -> None:
    prediction = followed(0.2, turning=0.5)
    np.testing.assert_allclose(prediction.velocity, [0.0, 0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(prediction.turning, [0.0, 0.0, 0.5], atol=1e-6)
    assert prediction.rest == 0.0
    assert prediction.lifted == pytest.approx(0.2)
    soon = prediction.soon(0.1)
    np.testing.assert_allclose(soon, pose(np.array([0.5, 0.22, 1.0]), 0.55), atol=1e-6)


@pytest.mark.parametrize("speed", [0.05, 0.3, 1.0])
def test_what_moves_is_drawn_on_and_to_the_usual_place(speed: float) -> None:
    config = OfferConfig()
    prediction = followed(speed)
    here = np.array([0.5, speed, 1.0])
    drawn = config.pull * np.tanh(speed / config.brisk)
    wanted = here + config.ahead * np.array([0.0, speed, 0.0]) + drawn * (np.array(config.place) - here)
    np.testing.assert_allclose(prediction.offered()[:3], wanted, atol=1e-6)


def test_seen_twice_at_the_same_time_it_has_not_moved() -> None:
    prediction = followed(0.2)
    before = prediction.velocity.copy()
    prediction.see(1.0, pose(np.array([0.5, 0.2, 1.0])))
    np.testing.assert_array_equal(prediction.velocity, before)


def swaying(times: np.ndarray, size: float) -> OfferPrediction:
    """One that was lifted by 0.3 m within half a second and sways from then on."""
    prediction = OfferPrediction(OfferConfig())
    for time in times:
        lifted = 0.3 * min(time / 0.5, 1.0)
        aside = size * np.sin(2.0 * np.pi * (time - 0.5)) if time > 0.5 else 0.0
        prediction.see(float(time), pose(np.array([0.5, aside, 1.0 + lifted])))
    return prediction


def test_what_sways_in_its_place_hovers() -> None:
    times = np.arange(0.0, 2.0, STEP)
    prediction = swaying(times, 0.03)
    assert prediction.hovers
    assert prediction.speed > OfferConfig().slow
    # It is not drawn to where others are held out.
    assert np.linalg.norm(prediction.offered()[:3] - prediction.soon(0.0)[:3]) < 0.02
    assert not swaying(times, 0.3).hovers


@pytest.mark.parametrize("seconds", [0.3, 0.9])
def test_what_was_just_lifted_does_not(seconds: float) -> None:
    """Nor does what has not been lifted at all."""
    assert not swaying(np.arange(0.0, seconds, STEP), 0.03).hovers
    assert not followed(0.0, 2.0).hovers


def test_points_of_a_turning_object_have_its_velocity_and_that_of_the_turn() -> None:
    prediction = followed(0.2, turning=0.5)
    linear, angular = prediction.twist(np.array([0.6, 0.2, 1.0]), STEP)
    np.testing.assert_allclose(angular, [0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(linear, [0.0, 0.2 + 0.5 * 0.1, 0.0], atol=1e-6)


def test_acceleration_goes_on_to_the_middle_of_the_next_period() -> None:
    prediction = OfferPrediction(OfferConfig())
    for time in np.arange(0.0, 0.5, STEP):
        prediction.see(float(time), pose(np.array([0.5, 0.5 * 2.0 * time**2, 1.0])))
    linear, _ = prediction.twist(np.array([0.5, 0.0, 1.0]), 0.02)
    assert linear[1] == pytest.approx(2.0 * (0.45 + 0.01), abs=1e-6)
