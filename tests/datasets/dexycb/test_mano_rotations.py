import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dexycb.mano_rotations import (
    KeyframeSpan,
    compute_norms,
    count_frames,
    fused_multiply_add,
    matrices_from_rotation_vectors,
    rotate_fused,
    rotate_unfused,
    scipy_euler_from_rotations,
    transforms3d_euler_from_matrices,
)

FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)


def rounded(exact: Fraction) -> np.float32:
    """Return the nearest float32 of an exact number; ties are rounded to even."""
    guess = np.float32(float(exact))
    around = [np.nextafter(guess, np.float32(-np.inf)), guess, np.nextafter(guess, np.float32(np.inf))]
    finite = [value for value in around if np.isfinite(value)]
    apart = [abs(Fraction(float(value)) - exact) for value in finite]
    nearest = [value for value, gap in zip(finite, apart, strict=True) if gap == min(apart)]
    return min(nearest, key=lambda value: int(value.view(np.int32)) & 1)


def fused(a: np.float32, b: np.float32, c: np.float32) -> np.float32:
    exact = Fraction(float(a)) * Fraction(float(b)) + Fraction(float(c))
    return rounded(exact) if exact else np.float32(0.0)


def one(a: float, b: float, c: float) -> np.float32:
    return fused_multiply_add(*(np.array([value], dtype=np.float32) for value in (a, b, c)))[0]


@settings(max_examples=300)
@given(a=FLOATS, b=FLOATS, c=FLOATS)
def test_fused_sums_round_once(a: float, b: float, c: float) -> None:
    assume(abs(a * b + c) < 3e38)
    assert one(a, b, c) == fused(np.float32(a), np.float32(b), np.float32(c))


def test_fused_sums_where_double_rounding_fails() -> None:
    a, b, c = np.float32(2.0**-24 * (1 + 2.0**-15)), np.float32(1 - 2.0**-15), np.float32(1 + 2.0**-23)
    twice = np.float32(np.float64(a) * np.float64(b) + np.float64(c))
    assert twice == np.float32(1 + 2.0**-22)
    for sign in (-1.0, 1.0):
        assert one(sign * a, b, sign * c) == sign * c == fused(sign * a, b, sign * c)


def test_rotate_fused_and_unfused() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        matrix = rng.uniform(-8.0, 8.0, (3, 3)).astype(np.float32)
        column = rng.uniform(-8.0, 8.0, 3).astype(np.float32)
        unfused = (matrix[:, 0] * column[0] + matrix[:, 1] * column[1]) + matrix[:, 2] * column[2]
        np.testing.assert_array_equal(rotate_unfused(matrix, column), unfused)
        for row, found in zip(matrix, rotate_fused(matrix, column[None, :, None])[0, :, 0], strict=True):
            assert found == fused(row[2], column[2], fused(row[1], column[1], row[0] * column[0]))


def test_compute_norms_rounds_as_blas() -> None:
    vectors = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    expected = []
    for vector in vectors:
        squares = [Fraction(float(rounded(Fraction(float(x)) ** 2))) for x in vector]
        expected.append(np.sqrt(rounded(sum(squares, Fraction()))))
    np.testing.assert_array_equal(compute_norms(vectors), np.array(expected))
    assert (compute_norms(vectors) != np.sqrt((vectors**2).sum(axis=1))).any()


def test_angle_and_axis_round_differently() -> None:
    """Matrices equal those that transforms3d 0.4.2 computed under NumPy 1.23.5.

    If angle and axis used the same sum of squares, the eighth digit would differ.
    """
    vectors = np.array([[-0.7454434, -0.04336259, -0.16392876], [0.502127, -0.9361622, -0.81068945]], dtype=np.float32)
    expected = [float.fromhex("0x1.4f7c5caa122b2p-3"), float.fromhex("0x1.8d4af38ed3b14p-2")]
    np.testing.assert_allclose(matrices_from_rotation_vectors(vectors)[:, 0, 1], expected, rtol=1e-13)


PI = math.pi
ANGLES = st.one_of(st.floats(-4.0, 4.0), st.sampled_from([quarter * PI / 4 for quarter in range(-4, 5)]))

#: Quaternions xyzw, and their Euler angles by SciPy 1.10.1. At y = +-pi / 2 only eight digits of y are significant.
OF_SCIPY = [
    ((1.0, 2.0, 3.0, 4.0), ("-0x1.94441f8f72600p-3", "0x1.a57c0a4edcbdcp-1", "0x1.5f97315254858p+0")),
    ((1.0, 0.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "0x0.0p+0")),
    ((0.0, 1.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((0.0, 0.0, 1.0, 0.0), ("0x0.0p+0", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((0.0, -1.0, 0.0, 1.0), ("0x0.0p+0", "-0x1.921fb59ec54b0p+0", "0x0.0p+0")),
    ((1.0, 0.0, 1.0, 0.0), ("0x1.921fb54442d18p+1", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    # Negative zeros in the matrix must not change x.
    ((-1.0, -0.0, 1.0, 0.0), ("0x1.921fb54442d18p+1", "-0x1.921fb59ec54b0p+0", "0x0.0p+0")),
    ((-0.5, 0.5, 0.5, 0.25), ("-0x1.d0d6a1369bd34p+0", "-0x1.4045eb6810728p-2", "0x1.d0d6a1369bd34p+0")),
]


def test_angles_equal_those_of_scipy_1_10() -> None:
    found = scipy_euler_from_rotations(Rotation.from_quat([quaternion for quaternion, _ in OF_SCIPY]))
    expected = np.array([[float.fromhex(text) for text in texts] for _, texts in OF_SCIPY])
    # Angles are stored as float32; the last bits of float64 depend on the C library.
    np.testing.assert_array_equal(found.astype(np.float32), expected.astype(np.float32))


@given(x=ANGLES, z=ANGLES, y=st.sampled_from([-PI / 2, PI / 2]))
def test_angles_at_gimbal_lock(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    assert scipy_euler_from_rotations(rotation)[0, 2] == 0.0
    exact = np.round(Rotation.from_euler("XYZ", [[0.0, y, 0.0]]).as_matrix())
    np.testing.assert_allclose(transforms3d_euler_from_matrices(exact), [[0.0, y, 0.0]], atol=1e-12)


@pytest.mark.parametrize("n_keyframes", [4, 66, 76])
def test_times_equal_those_of_the_original(n_keyframes: int) -> None:
    span = KeyframeSpan(0, n_keyframes - 1)
    keys = np.arange(0, n_keyframes * 0.04, 0.04)
    times = np.arange(0, n_keyframes * 0.04, 0.001)
    np.testing.assert_array_equal(span._key_times(), keys)
    np.testing.assert_array_equal(span._times(), times[times <= keys[-1]])
    assert len(span._times()) == count_frames(n_keyframes)
