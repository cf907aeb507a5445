import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.datasets.dexycb.rotations import (
    STRIDE,
    KeyframeSpan,
    TagFrame,
    can_original_resample,
    compute_norms,
    count_frames,
    fused_multiply_add,
    matrices_from_rotation_vectors,
    quaternions_from_matrices,
    rotate_fused,
    rotate_unfused,
    scipy_euler_from_rotations,
    transforms3d_euler_from_matrices,
)
from tests.datasets.dexycb.raw_files import random_rotations, tag_pose

FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)
TAME = st.floats(-8.0, 8.0, width=32)


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


@settings(max_examples=1000)
@given(a=FLOATS, b=FLOATS, c=FLOATS)
def test_fused_sums_round_once(a: float, b: float, c: float) -> None:
    assume(abs(a * b + c) < 3e38)
    assert one(a, b, c) == fused(np.float32(a), np.float32(b), np.float32(c))


@settings(max_examples=1000)
@given(steps=st.integers(0, 2**23), shift=st.integers(1, 30), sign=st.sampled_from([-1.0, 1.0]))
def test_fused_sums_next_to_half_way_points(steps: int, shift: int, sign: float) -> None:
    """A fused sum is rounded once where the product is nearly half a unit in the last place of c.

    The difference from half a unit is often too small for a sum in float64.
    """
    c = 1.0 + steps * 2.0**-23
    a, b = 2.0**-24 * (1.0 + 2.0**-shift) if shift <= 23 else 2.0**-24, sign * (1.0 - 2.0 ** -min(shift, 23))
    assert one(a, b, c) == fused(np.float32(a), np.float32(b), np.float32(c))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_fused_sums_where_double_rounding_fails(sign: float) -> None:
    a, b, c = np.float32(2.0**-24 * (1 + 2.0**-15)), np.float32(1 - 2.0**-15), np.float32(1 + 2.0**-23)
    twice = np.float32(np.float64(a) * np.float64(b) + np.float64(c))
    assert twice == np.float32(1 + 2.0**-22)
    assert one(sign * a, b, sign * c) == sign * c == fused(sign * a, b, sign * c)


@settings(max_examples=100)
@given(entries=st.lists(TAME, min_size=9 + 6, max_size=9 + 6))
def test_rotate_fused_and_unfused(entries: list[float]) -> None:
    matrix = np.array(entries[:9], dtype=np.float32).reshape(3, 3)
    columns = np.array(entries[9:], dtype=np.float32).reshape(1, 3, 2)
    found = rotate_fused(matrix, columns)
    assert found.shape == (1, 3, 2)
    for row in range(3):
        for column in range(2):
            total = rounded(Fraction(float(matrix[row, 0])) * Fraction(float(columns[0, 0, column])))
            for k in (1, 2):
                total = fused(matrix[row, k], columns[0, k, column], total)
            assert found[0, row, column] == total
    expected = [
        (matrix[row, 0] * columns[0, 0, 0] + matrix[row, 1] * columns[0, 1, 0]) + matrix[row, 2] * columns[0, 2, 0]
        for row in range(3)
    ]
    np.testing.assert_array_equal(rotate_unfused(matrix, columns[0, :, 0]), np.array(expected, dtype=np.float32))


def test_compute_norms_rounds_as_blas() -> None:
    vectors = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    expected = []
    for vector in vectors:
        squares = [Fraction(float(rounded(Fraction(float(x)) ** 2))) for x in vector]
        expected.append(np.sqrt(rounded(sum(squares, Fraction()))))
    np.testing.assert_array_equal(compute_norms(vectors), np.array(expected))
    assert (compute_norms(vectors) != np.sqrt((vectors**2).sum(axis=1))).any()


VECTORS = st.lists(st.floats(-4.0, 4.0, width=32), min_size=3, max_size=3)


@given(vector=VECTORS)
def test_matrices_of_vectors(vector: list[float]) -> None:
    vectors = np.array([vector], dtype=np.float32)
    found = matrices_from_rotation_vectors(vectors)
    assert found.shape == (1, 3, 3)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(found[0] @ found[0].T, np.eye(3), atol=1e-6)


def test_zero_and_tiny_rotation_vectors() -> None:
    vectors = np.array([[0.0, 0.0, 0.0], [1e-30, 0.0, 0.0], [0.0, 1e-22, 0.0], [0.0, 0.0, 1e-4]], dtype=np.float32)
    found = matrices_from_rotation_vectors(vectors)
    np.testing.assert_array_equal(found[:2], [np.eye(3)] * 2)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)


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
    ((-3.0, 1.0, 2.0, 1.0), ("-0x1.0468a8ace4df6p+1", "-0x1.759edd04f68e0p-1", "0x1.1b6e192ebbe40p+0")),
    ((1.0, 0.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "0x0.0p+0")),
    ((-1.0, 0.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "0x0.0p+0")),
    ((0.0, 1.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((0.0, 0.0, 1.0, 0.0), ("0x0.0p+0", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((0.0, 0.0, 0.0, 1.0), ("0x0.0p+0", "0x0.0p+0", "0x0.0p+0")),
    ((1.0, 1.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "-0x1.921fb54442d18p+0")),
    ((0.0, 1.0, 0.0, 1.0), ("0x0.0p+0", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    ((0.0, -1.0, 0.0, 1.0), ("0x0.0p+0", "-0x1.921fb59ec54b0p+0", "0x0.0p+0")),
    ((1.0, 1.0, 1.0, 1.0), ("0x1.921fb54442d18p+0", "0x1.921fb54442d18p+0", "0x0.0p+0")),
    ((1.0, 0.0, 1.0, 0.0), ("0x1.921fb54442d18p+1", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    # Negative zeros in the matrix must not change x.
    ((-1.0, -0.0, 1.0, 0.0), ("0x1.921fb54442d18p+1", "-0x1.921fb59ec54b0p+0", "0x0.0p+0")),
    ((0.5, -0.0, 0.5, -0.0), ("0x1.921fb54442d18p+1", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    ((0.0, 1.0, 1.0, 0.0), ("-0x1.921fb54442d18p+0", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((-0.5, 0.5, 0.5, 0.25), ("-0x1.d0d6a1369bd34p+0", "-0x1.4045eb6810728p-2", "0x1.d0d6a1369bd34p+0")),
]


@pytest.mark.parametrize(("quaternion", "expected"), OF_SCIPY)
def test_angles_equal_those_of_scipy_1_10(quaternion: tuple[float, ...], expected: tuple[str, ...]) -> None:
    found = scipy_euler_from_rotations(Rotation.from_quat([quaternion]))[0]
    # Angles are stored as float32; the last bits of float64 depend on the C library.
    np.testing.assert_array_equal(
        found.astype(np.float32), np.array([float.fromhex(text) for text in expected], dtype=np.float32)
    )


@given(x=ANGLES, y=ANGLES, z=ANGLES)
def test_angles_give_the_same_rotation(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    for angles in (scipy_euler_from_rotations(rotation), transforms3d_euler_from_matrices(rotation.as_matrix())):
        again = Rotation.from_euler("XYZ", angles)
        assert (again * rotation.inv()).magnitude()[0] < 1e-6
        assert np.abs(angles[:, 1]).max() <= PI / 2 + 1e-7
        assert np.abs(angles).max() <= PI


@given(x=ANGLES, z=ANGLES, y=st.sampled_from([-PI / 2, PI / 2]))
def test_angles_at_gimbal_lock(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    assert scipy_euler_from_rotations(rotation)[0, 2] == 0.0
    exact = np.round(Rotation.from_euler("XYZ", [[0.0, y, 0.0]]).as_matrix())
    np.testing.assert_allclose(transforms3d_euler_from_matrices(exact), [[0.0, y, 0.0]], atol=1e-12)


@given(x=st.floats(-3.1, 3.1), y=st.floats(-1.5, 1.5), z=st.floats(-3.1, 3.1))
def test_both_conversions_agree(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    np.testing.assert_allclose(scipy_euler_from_rotations(rotation), [[x, y, z]], atol=1e-7)
    np.testing.assert_allclose(transforms3d_euler_from_matrices(rotation.as_matrix()), [[x, y, z]], atol=1e-7)


SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS)
def test_points_are_transformed_and_back(seed: int) -> None:
    pose = tag_pose(seed)
    points = np.random.default_rng(seed).normal(size=(7, 3))
    world = points @ pose[:, :3].T + pose[:, 3]
    found = TagFrame.from_extrinsics(pose).transform_points(world.astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, points, atol=3e-6)


@given(seed=SEEDS)
def test_rotations_in_the_tag_frame(seed: int) -> None:
    pose, world = tag_pose(seed), random_rotations(5, seed)
    found = TagFrame.from_extrinsics(pose).transform_rotations(world)
    assert found.dtype == np.float32
    expected = Rotation.from_matrix(pose[:, :3]).inv() * world
    assert (Rotation.from_quat(found) * expected.inv()).magnitude().max() < 1e-6


def test_the_tag_itself_is_the_origin() -> None:
    pose = tag_pose(3)
    tag = TagFrame.from_extrinsics(pose)
    np.testing.assert_allclose(tag.transform_points(pose[None, :, 3].astype(np.float32)), 0.0, atol=1e-6)
    found = np.abs(tag.transform_rotations(Rotation.from_matrix(pose[None, :, :3])))
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.0, 1.0]], atol=1e-6)


@given(seed=SEEDS)
def test_matrices_are_not_orthogonalized(seed: int) -> None:
    rotation = random_rotations(20, seed)
    exact = quaternions_from_matrices(rotation.as_matrix())
    assert (np.abs(np.sum(exact * rotation.as_quat(), axis=1)) > 1.0 - 1e-12).all()
    # A matrix that is stretched by 1 % along x gives the quaternion of its largest entry.
    x, y, z, w = quaternions_from_matrices(np.diag([1.01, 1.0, 1.0])[None])[0]
    assert (x, y, z, w) == (0.0, 0.0, 0.0, 1.0)


def test_quaternions_with_each_largest_entry() -> None:
    quaternions = np.concatenate([np.eye(4), 0.9 * np.eye(4) + 0.1])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    found = quaternions_from_matrices(Rotation.from_quat(quaternions).as_matrix())
    np.testing.assert_allclose(found, quaternions, atol=1e-15)


def test_lengths_that_the_original_cannot_resample() -> None:
    cannot = [n for n in range(4, 200) if not can_original_resample(n)]
    assert cannot == [7, 14, 28, 56, 57, 111, 112, 113, 114, 115]
    assert [n for n in range(4) if can_original_resample(n)] == []
    for n in range(4, 2000):
        assert can_original_resample(n) == (len(np.arange(0, n * 0.04, 0.04)) == n)


@pytest.mark.parametrize("n_keyframes", [4, 66, 68, 70, 72, 74, 76])
def test_times_equal_those_of_the_original(n_keyframes: int) -> None:
    span = KeyframeSpan(0, n_keyframes - 1)
    keys = np.arange(0, n_keyframes * 0.04, 0.04)
    times = np.arange(0, n_keyframes * 0.04, 0.001)
    np.testing.assert_array_equal(span._key_times(), keys)
    np.testing.assert_array_equal(span._times(), times[times <= keys[-1]])
    assert len(span._times()) == count_frames(n_keyframes)


@given(first=st.integers(0, 80), n=st.integers(4, 80), seed=st.integers(0, 1000))
def test_keyframes_are_interpolated(first: int, n: int, seed: int) -> None:
    rng, span = np.random.default_rng(seed), KeyframeSpan(first, first + n - 1)
    assert span.n_keyframes == n
    keys = rng.normal(size=(n, 3)).astype(np.float32)
    positions = span.interpolate_positions(keys)
    assert positions.dtype == np.float32
    assert len(positions) == span.frames.stop - span.frames.start == count_frames(n)
    np.testing.assert_allclose(positions[::STRIDE], keys, atol=1e-5)
    quaternions = random_rotations(n, seed).as_quat().astype(np.float32)
    rotations = span.interpolate_rotations(quaternions)
    apart = rotations[::STRIDE] * Rotation.from_quat(quaternions).inv()
    assert apart.magnitude().max() < 1e-6


def test_constant_speed_stays_constant() -> None:
    time = np.arange(8)[:, None]
    line = KeyframeSpan(0, 7).interpolate_positions((time * [0.4, -0.8, 0.0]).astype(np.float32))
    np.testing.assert_allclose(np.diff(line, axis=0), [[0.01, -0.02, 0.0]] * (len(line) - 1), atol=1e-6)
    turn = KeyframeSpan(0, 7).interpolate_rotations(
        Rotation.from_rotvec(time * [0.0, 0.2, 0.0]).as_quat().astype(np.float32)
    )
    np.testing.assert_allclose((turn[1:] * turn[:-1].inv()).as_rotvec(), [[0.0, 0.005, 0.0]] * 280, atol=1e-6)


def test_rotations_are_kept_as_float32_quaternions() -> None:
    span, keys = KeyframeSpan(0, 9), random_rotations(10, 0).as_quat().astype(np.float32)
    exact = Slerp(span._key_times(), Rotation.from_quat(keys))(span._times()).as_quat()
    found = span.interpolate_rotations(keys).as_quat()
    np.testing.assert_array_equal(found, Rotation.from_quat(exact.astype(np.float32)).as_quat())
    assert (found != exact).any()


def test_signs_of_quaternions_do_not_matter() -> None:
    keys = Rotation.from_rotvec(np.linspace(0.0, 1.0, 5)[:, None] * [0.0, 0.0, 0.8]).as_quat().astype(np.float32)
    flipped = keys * np.array([[1], [-1], [1], [-1], [-1]], dtype=np.float32)
    apart = KeyframeSpan(0, 4).interpolate_rotations(keys) * KeyframeSpan(0, 4).interpolate_rotations(flipped).inv()
    assert apart.magnitude().max() < 1e-6
