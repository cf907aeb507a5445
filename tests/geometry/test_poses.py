import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from handover_marl.geometry.poses import (
    compose,
    compute_rotation_angle,
    inverse_transform_points,
    invert_pose,
    multiply_quaternions,
    poses_from_matrices,
    quaternion_from_matrix,
    quaternions_from_euler,
    rotate_points,
)

COORDINATES = arrays(np.float64, 3, elements=st.floats(-10, 10))
ROTATION_VECTORS = arrays(np.float64, 3, elements=st.floats(-3, 3))


def quaternion(vector: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_quat()


@given(ROTATION_VECTORS, ROTATION_VECTORS)
def test_multiply_equals_scipy(first: np.ndarray, second: np.ndarray) -> None:
    product = multiply_quaternions(quaternion(first), quaternion(second))
    expected = (Rotation.from_rotvec(first) * Rotation.from_rotvec(second)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(product).as_matrix(), expected, atol=1e-12)


@given(ROTATION_VECTORS, COORDINATES)
def test_rotate_equals_scipy(vector: np.ndarray, point: np.ndarray) -> None:
    np.testing.assert_allclose(
        rotate_points(quaternion(vector), point), Rotation.from_rotvec(vector).apply(point), atol=1e-11
    )


@given(ROTATION_VECTORS, COORDINATES, ROTATION_VECTORS, COORDINATES, COORDINATES)
def test_compose_chains_frames(
    first: np.ndarray, offset: np.ndarray, second: np.ndarray, other: np.ndarray, point: np.ndarray
) -> None:
    a_from_b = np.concatenate([offset, quaternion(first)])
    b_from_c = np.concatenate([other, quaternion(second)])
    in_b = Rotation.from_rotvec(second).apply(point) + other
    in_a = Rotation.from_rotvec(first).apply(in_b) + offset
    chained = compose(a_from_b, b_from_c)
    np.testing.assert_allclose(rotate_points(chained[3:], point) + chained[:3], in_a, atol=1e-10)
    np.testing.assert_allclose(inverse_transform_points(chained, in_a), point, atol=1e-9)
    np.testing.assert_allclose(compose(invert_pose(chained), np.append(in_a, [0, 0, 0, 1]))[:3], point, atol=1e-9)


@given(ROTATION_VECTORS)
def test_matrix_to_quaternion_equals_scipy(vector: np.ndarray) -> None:
    matrix = Rotation.from_rotvec(vector).as_matrix()
    found = quaternion_from_matrix(matrix)
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), matrix, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found), 1.0, atol=1e-14)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = matrix, (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(poses_from_matrices([transform]), [[1.0, 2.0, 3.0, *found]])


@given(ROTATION_VECTORS, st.floats(1e-3, np.pi - 1e-3))
def test_rotation_angle(vector: np.ndarray, angle: float) -> None:
    base = Rotation.from_rotvec(vector)
    turned = base * Rotation.from_rotvec([0.0, angle, 0.0])
    assert abs(compute_rotation_angle(base.as_quat(), turned.as_quat()) - angle) < 1e-6
    assert abs(compute_rotation_angle(base.as_quat(), -turned.as_quat()) - angle) < 1e-6


def test_quaternions_are_bit_equal_to_scipy() -> None:
    angles = np.random.default_rng(5).normal(size=(2000, 3))
    np.testing.assert_array_equal(quaternions_from_euler(angles), Rotation.from_euler("XYZ", angles).as_quat())
    single = angles.astype(np.float32)
    np.testing.assert_array_equal(
        quaternions_from_euler(single),
        Rotation.from_euler("XYZ", single.astype(np.float64)).as_quat(),
        "float32 counts in full",
    )
