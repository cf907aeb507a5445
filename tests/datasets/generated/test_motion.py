import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.datasets.generated.motion import resample_fingers, resample_poses

GRID = 2.0**-23


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
    ends = 0.04 * np.arange(n)
    times = np.linspace(0.0, ends[-1], 40 * (n - 1) + 1)
    angles = resample_poses(ends, np.zeros((n, 3)), keyframes, times)[:, 3:]
    np.testing.assert_allclose(angles, np.unwrap(Slerp(ends, keyframes)(times).as_euler("XYZ"), axis=0), atol=GRID)
    angles = resample_fingers(ends, fingers, times)
    for joint in (0, 7, 14):
        path = Slerp(ends, Rotation.from_euler("XYZ", fingers[:, 3 * joint : 3 * joint + 3]))(times).as_euler("XYZ")
        np.testing.assert_allclose(angles[:, 3 * joint : 3 * joint + 3], path, atol=GRID)


@pytest.mark.parametrize("axis", [0, 2])
def test_angles_have_no_jumps(axis: int) -> None:
    """The angles of a motion of more than two turns about an axis are continuous."""
    vectors, ends = np.zeros((40, 3)), 0.04 * np.arange(40)
    vectors[:, axis] = np.linspace(0.0, 14.0, 40)
    times = np.linspace(0.0, ends[-1], 1561)
    angles = resample_poses(ends, np.zeros((40, 3)), Rotation.from_rotvec(vectors), times)[:, 3:]
    np.testing.assert_allclose(angles[:, axis], np.linspace(0.0, 14.0, len(angles)), atol=2e-6)
    assert np.abs(np.delete(angles, axis, axis=1)).max() < 1e-6
