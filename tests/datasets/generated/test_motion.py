import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.datasets.generated.motion import resample_fingers, resample_poses


@pytest.mark.parametrize("seed", range(5))
def test_rotations_between_keyframes_equal_scipy(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 4 + seed
    # The motion has large and small turns, and keyframes without a turn.
    turns = rng.normal(size=(n, 3)) * rng.choice([0.0, 0.02, 1.0], size=(n, 1))
    rotations = [Rotation.random(rng=rng)]
    for turn in turns[1:]:
        rotations.append(Rotation.from_rotvec(turn) * rotations[-1])
    keyframes, fingers, ends = Rotation.concatenate(rotations), rng.uniform(-1.0, 1.0, (n, 45)), 0.04 * np.arange(n)
    fingers[n // 2 :] = fingers[n // 2]
    times = np.linspace(0.0, ends[-1], 40 * (n - 1) + 1)
    angles = resample_poses(ends, np.zeros((n, 3)), keyframes, times)[:, 3:]
    expected = np.unwrap(Slerp(ends, keyframes)(times).as_euler("XYZ"), axis=0)
    np.testing.assert_allclose(angles, expected, atol=2.0**-23)
    joint = Slerp(ends, Rotation.from_euler("XYZ", fingers[:, 21:24]))(times).as_euler("XYZ")
    np.testing.assert_allclose(resample_fingers(ends, fingers, times)[:, 21:24], joint, atol=2.0**-23)


@pytest.mark.parametrize("axis", [0, 2])
def test_angles_have_no_jumps(axis: int) -> None:
    """The angles of a motion of more than two turns about an axis are continuous."""
    vectors, ends = np.zeros((40, 3)), 0.04 * np.arange(40)
    vectors[:, axis] = np.linspace(0.0, 14.0, 40)
    times = np.linspace(0.0, ends[-1], 1561)
    angles = resample_poses(ends, np.zeros((40, 3)), Rotation.from_rotvec(vectors), times)[:, 3:]
    np.testing.assert_allclose(angles[:, axis], np.linspace(0.0, 14.0, len(angles)), atol=2e-6)
    assert np.abs(np.delete(angles, axis, axis=1)).max() < 1e-6
