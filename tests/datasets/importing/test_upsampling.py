import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.datasets.importing.upsampling import STRIDE, Span, n_frames, original_can
from tests.datasets.importing.raw_files import random_rotations


def test_lengths_at_which_the_original_stops() -> None:
    cannot = [n for n in range(4, 200) if not original_can(n)]
    assert cannot == [7, 14, 28, 56, 57, 111, 112, 113, 114, 115]
    assert [n for n in range(4) if original_can(n)] == []
    for n in range(4, 2000):
        assert original_can(n) == (len(np.arange(0, n * 0.04, 0.04)) == n)


@pytest.mark.parametrize("n_keys", [4, 66, 68, 70, 72, 74, 76])
def test_times_are_those_of_the_original(n_keys: int) -> None:
    span = Span(0, n_keys - 1)
    keys = np.arange(0, n_keys * 0.04, 0.04)
    times = np.arange(0, n_keys * 0.04, 0.001)
    np.testing.assert_array_equal(span._key_times(), keys)
    np.testing.assert_array_equal(span._times(), times[times <= keys[-1]])
    assert len(span._times()) == n_frames(n_keys)


@given(first=st.integers(0, 80), n=st.integers(4, 80), seed=st.integers(0, 1000))
def test_key_poses_are_met(first: int, n: int, seed: int) -> None:
    rng, span = np.random.default_rng(seed), Span(first, first + n - 1)
    assert span.n_keys == n
    keys = rng.normal(size=(n, 3)).astype(np.float32)
    positions = span.positions(keys)
    assert positions.dtype == np.float32
    assert len(positions) == span.frames.stop - span.frames.start == n_frames(n)
    np.testing.assert_allclose(positions[::STRIDE], keys, atol=1e-5)
    quaternions = random_rotations(n, seed).as_quat().astype(np.float32)
    rotations = span.rotations(quaternions)
    apart = rotations[::STRIDE] * Rotation.from_quat(quaternions).inv()
    assert apart.magnitude().max() < 1e-6


def test_constant_speed_stays_constant() -> None:
    time = np.arange(8)[:, None]
    line = Span(0, 7).positions((time * [0.4, -0.8, 0.0]).astype(np.float32))
    np.testing.assert_allclose(np.diff(line, axis=0), [[0.01, -0.02, 0.0]] * (len(line) - 1), atol=1e-6)
    turn = Span(0, 7).rotations(Rotation.from_rotvec(time * [0.0, 0.2, 0.0]).as_quat().astype(np.float32))
    np.testing.assert_allclose((turn[1:] * turn[:-1].inv()).as_rotvec(), [[0.0, 0.005, 0.0]] * 280, atol=1e-6)


def test_rotations_are_kept_as_float32_quaternions() -> None:
    span, keys = Span(0, 9), random_rotations(10, 0).as_quat().astype(np.float32)
    exact = Slerp(span._key_times(), Rotation.from_quat(keys))(span._times()).as_quat()
    found = span.rotations(keys).as_quat()
    np.testing.assert_array_equal(found, Rotation.from_quat(exact.astype(np.float32)).as_quat())
    assert (found != exact).any()


def test_signs_of_quaternions_do_not_matter() -> None:
    keys = Rotation.from_rotvec(np.linspace(0.0, 1.0, 5)[:, None] * [0.0, 0.0, 0.8]).as_quat().astype(np.float32)
    flipped = keys * np.array([[1], [-1], [1], [-1], [-1]], dtype=np.float32)
    apart = Span(0, 4).rotations(keys) * Span(0, 4).rotations(flipped).inv()
    assert apart.magnitude().max() < 1e-6
