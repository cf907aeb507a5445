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
