"""Tests of handover pose prediction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.planning.handover_prediction import HandoverPosePredictor, HandoverPosePredictorConfig

STEP = 0.05


def pose(position: np.ndarray, turn: float = 0.0) -> np.ndarray:
    return np.concatenate([position, Rotation.from_euler("z", turn).as_quat()])


def track_steady_motion(speed: float, seconds: float = 1.0, angular_velocity: float = 0.0) -> HandoverPosePredictor:
    predictor = HandoverPosePredictor(HandoverPosePredictorConfig())
    for number in range(round(seconds / STEP) + 1):
        time = number * STEP
        predictor.update(time, pose(np.array([0.5, speed * time, 1.0]), angular_velocity * time))
    return predictor


def test_velocity_of_a_steady_motion() -> None:
    predictor = track_steady_motion(0.2, angular_velocity=0.5)
    np.testing.assert_allclose(predictor.velocity, [0.0, 0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(predictor.angular_velocity, [0.0, 0.0, 0.5], atol=1e-6)
    assert predictor.rest_time == 0.0
    assert predictor.lift_distance == pytest.approx(0.2)
    extrapolate_pose = predictor.extrapolate_pose(0.1)
    np.testing.assert_allclose(extrapolate_pose, pose(np.array([0.5, 0.22, 1.0]), 0.55), atol=1e-6)


def test_moving_object_is_extrapolated_and_attracted() -> None:
    speed = 0.3
    config = HandoverPosePredictorConfig()
    predictor = track_steady_motion(speed)
    here = np.array([0.5, speed, 1.0])
    pulled = config.attraction * np.tanh(speed / config.attraction_speed)
    ahead = config.velocity_horizon * np.array([0.0, speed, 0.0])
    wanted = here + ahead + pulled * (np.array(config.mean_handover_position) - here)
    np.testing.assert_allclose(predictor.predict_handover_pose()[:3], wanted, atol=1e-6)


def track_swaying_motion(times: np.ndarray, size: float) -> HandoverPosePredictor:
    """Return the predictor of an object that is lifted by 0.3 m in 0.5 s and then sways."""
    predictor = HandoverPosePredictor(HandoverPosePredictorConfig())
    for time in times:
        lift_distance = 0.3 * min(time / 0.5, 1.0)
        aside = size * np.sin(2.0 * np.pi * (time - 0.5)) if time > 0.5 else 0.0
        predictor.update(float(time), pose(np.array([0.5, aside, 1.0 + lift_distance])))
    return predictor


def test_swaying_object_counts_as_held_still() -> None:
    times = np.arange(0.0, 2.0, STEP)
    predictor = track_swaying_motion(times, 0.03)
    assert predictor.is_held_still
    assert predictor.speed > HandoverPosePredictorConfig().rest_speed
    # An object that is held still is not attracted to the mean handover position.
    assert np.linalg.norm(predictor.predict_handover_pose()[:3] - predictor.extrapolate_pose(0.0)[:3]) < 0.02
    assert not track_swaying_motion(times, 0.3).is_held_still
