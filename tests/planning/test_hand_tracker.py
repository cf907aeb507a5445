"""Tests of tracking a person's hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.planning.hand_tracker import HandTracker

numbers = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@pytest.fixture(scope="module")
def observation() -> Observation:
    episode = Episode("fast")
    episode.reset(SyntheticDataset().load_scene(5))
    observation = episode.observe()
    episode.close()
    return observation


def predict_attached_pose(observation: Observation, translation: np.ndarray, rotation: Rotation) -> Observation:
    points = observation["hand_keypoints"].astype(np.float64)
    center = points.mean(axis=0)
    return {**observation, "hand_keypoints": center + translation + rotation.apply(points - center)}


@given(numbers, numbers, numbers)
def test_attached_pose_moves_with_the_hand(
    observation: Observation, translation: np.ndarray, rotation_vector: np.ndarray, position: np.ndarray
) -> None:
    tracker, rotation = HandTracker(), Rotation.from_rotvec(rotation_vector)
    tracker.update(0.0, observation)
    before = tracker.points.copy()
    tracker.update(0.1, predict_attached_pose(observation, translation, rotation))
    pose = np.concatenate([position, [0.0, 0.0, 0.0, 1.0]])
    center = before.mean(axis=0)
    found = tracker.predict_attached_pose(before, pose, 0.0)
    np.testing.assert_allclose(found[:3], center + translation + rotation.apply(position - center), atol=1e-4)
    assert abs(float(found[3:] @ rotation.as_quat())) == pytest.approx(1.0, abs=1e-5)


def test_without_a_hand_the_pose_stays(observation: Observation) -> None:
    tracker = HandTracker()
    tracker.update(0.0, observation)
    before = tracker.points.copy()
    tracker.update(0.1, {**observation, "hand_present": np.zeros(1, dtype=np.float32)})
    pose = np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(tracker.predict_attached_pose(before, pose, 0.1), pose)
    assert tracker.spheres is None
