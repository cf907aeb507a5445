import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.datasets.synthetic.handover_motion import KEYFRAME_PERIOD, KeyframeMotion
from handover_marl.datasets.synthetic.resampling import STRIDE, compute_hand_trajectory, compute_object_trajectory

GRID = 2.0**-23


def make_motion(rotations: Rotation, fingers: np.ndarray) -> KeyframeMotion:
    still = np.zeros((len(fingers), 3))
    return KeyframeMotion(still, rotations, still, rotations, fingers, 0)


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
@settings(max_examples=30, deadline=None)
def test_rotations_between_keyframes_equal_scipy(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    # The motion has large and small turns, and keyframes without a turn.
    turns = rng.normal(size=(n, 3)) * rng.choice([0.0, 0.02, 1.0], size=(n, 1))
    rotations = [Rotation.random(rng=rng)]
    for turn in turns[1:]:
        rotations.append(Rotation.from_rotvec(turn) * rotations[-1])
    keyframes = Rotation.concatenate(rotations)
    fingers = rng.uniform(-1.0, 1.0, (n, 45))
    fingers[n // 2 :] = fingers[n // 2]
    times = np.arange((n - 1) * STRIDE + 1) * (KEYFRAME_PERIOD / STRIDE)
    ends = np.arange(n) * KEYFRAME_PERIOD
    times[-1] = ends[-1]
    angles = compute_object_trajectory(make_motion(keyframes, fingers))[:, 3:]
    exact = np.unwrap(Slerp(ends, keyframes)(times).as_euler("XYZ"), axis=0)
    np.testing.assert_allclose(angles, exact, atol=GRID)
    hand = compute_hand_trajectory(make_motion(keyframes, fingers))
    np.testing.assert_allclose(hand[:, 3:6], exact, atol=GRID)
    for joint in (0, 7, 14):
        path = Slerp(ends, Rotation.from_euler("XYZ", fingers[:, 3 * joint : 3 * joint + 3]))(times).as_euler("XYZ")
        np.testing.assert_allclose(hand[:, 6 + 3 * joint : 9 + 3 * joint], path, atol=GRID)


@pytest.mark.parametrize("axis", [0, 2])
def test_angles_have_no_jumps(axis: int) -> None:
    """The angles of a motion of more than two turns about an axis are continuous."""
    vectors = np.zeros((40, 3))
    vectors[:, axis] = np.linspace(0.0, 14.0, 40)
    angles = compute_object_trajectory(make_motion(Rotation.from_rotvec(vectors), np.zeros((40, 45))))[:, 3:]
    np.testing.assert_allclose(angles[:, axis], np.linspace(0.0, 14.0, len(angles)), atol=2e-6)
    assert np.abs(np.delete(angles, axis, axis=1)).max() < 1e-6
