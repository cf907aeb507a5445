"""A hand that moves."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.planning.person_motion import HandMotion

numbers = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@pytest.fixture(scope="module")
def seen() -> Observation:
    episode = Episode("fast")
    episode.reset(SyntheticDataset().scene(5))
    observation = episode.observe()
    episode.close()
    return observation


def moved(observation: Observation, way: np.ndarray, turn: Rotation) -> Observation:
    points = observation["hand_keypoints"].astype(np.float64)
    middle = points.mean(axis=0)
    return {**observation, "hand_keypoints": middle + way + turn.apply(points - middle)}


@given(numbers, numbers, numbers)
def test_what_is_fixed_to_it_moves_with_it(
    seen: Observation, way: np.ndarray, turning: np.ndarray, place: np.ndarray
) -> None:
    motion, turn = HandMotion(), Rotation.from_rotvec(turning)
    motion.see(0.0, seen)
    before = motion.points.copy()
    motion.see(0.1, moved(seen, way, turn))
    pose = np.concatenate([place, [0.0, 0.0, 0.0, 1.0]])
    middle = before.mean(axis=0)
    found = motion.moved(before, pose, 0.0)
    np.testing.assert_allclose(found[:3], middle + way + turn.apply(place - middle), atol=1e-4)
    assert abs(float(found[3:] @ turn.as_quat())) == pytest.approx(1.0, abs=1e-5)


def test_a_little_later_it_is_further_on(seen: Observation) -> None:
    motion = HandMotion()
    for number in range(20):
        motion.see(0.05 * number, moved(seen, np.array([0.0, 0.01 * number, 0.0]), Rotation.identity()))
    np.testing.assert_allclose(motion.velocity, [0.0, 0.2, 0.0], atol=1e-3)
    pose = np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(motion.moved(motion.points, pose, 0.1)[:3], [0.5, 0.52, 0.5], atol=1e-4)


def test_without_a_hand_it_stays_where_it_was(seen: Observation) -> None:
    motion = HandMotion()
    motion.see(0.0, seen)
    before = motion.points.copy()
    motion.see(0.1, {**seen, "hand_present": np.zeros(1, dtype=np.float32)})
    pose = np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(motion.moved(before, pose, 0.1), pose)
    assert motion.balls is None
