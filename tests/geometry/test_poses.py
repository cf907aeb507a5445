"""Tests of poses and rotations against SciPy, and of tensors against arrays."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from handover_marl.geometry import poses, rotations
from handover_marl.geometry.arrays import is_tensor, to_numpy
from handover_marl.geometry.vectors import compute_dot_products, compute_lengths

Array = npt.NDArray[np.float64]
COORDINATES = arrays(np.float64, 3, elements=st.floats(-10, 10))
ROTATION_VECTORS = arrays(np.float64, 3, elements=st.floats(-3, 3))


def quaternion(vector: Array) -> Array:
    return Rotation.from_rotvec(vector).as_quat()


@settings(max_examples=50)
@given(ROTATION_VECTORS, COORDINATES, ROTATION_VECTORS, COORDINATES, COORDINATES)
def test_compositions_equal_scipy(first: Array, offset: Array, second: Array, other: Array, point: Array) -> None:
    a_from_b = np.concatenate([offset, quaternion(first)])
    b_from_c = np.concatenate([other, quaternion(second)])
    product = rotations.multiply_quaternions(quaternion(first), quaternion(second))
    matrix = (Rotation.from_rotvec(first) * Rotation.from_rotvec(second)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(product).as_matrix(), matrix, atol=1e-12)
    in_b = Rotation.from_rotvec(second).apply(point) + other
    in_a = Rotation.from_rotvec(first).apply(in_b) + offset
    chained = poses.compose(a_from_b, b_from_c)
    np.testing.assert_allclose(rotations.rotate_points(chained[3:], point) + chained[:3], in_a, atol=1e-10)
    np.testing.assert_allclose(poses.inverse_transform_points(chained, in_a), point, atol=1e-9)
    point_pose = np.append(in_a, [0, 0, 0, 1])
    np.testing.assert_allclose(poses.compose(poses.invert_pose(chained), point_pose)[:3], point, atol=1e-9)


@settings(max_examples=50)
@given(ROTATION_VECTORS, st.floats(1e-3, np.pi - 1e-3))
def test_matrices_and_angles_equal_scipy(vector: Array, angle: float) -> None:
    base = Rotation.from_rotvec(vector)
    found = rotations.quaternions_from_matrices(base.as_matrix())
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), base.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found), 1.0, atol=1e-14)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = base.as_matrix(), (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(poses.poses_from_matrices([transform]), [[1.0, 2.0, 3.0, *found]])
    turned = (base * Rotation.from_rotvec([0.0, angle, 0.0])).as_quat()
    for other in (turned, -turned):
        assert abs(rotations.compute_rotation_angles(base.as_quat(), other) - angle) < 1e-6


def test_quaternions_of_euler_angles_are_bit_equal_to_scipy() -> None:
    angles = np.random.default_rng(5).normal(size=(2000, 3))
    for own in (angles, angles.astype(np.float32)):
        expected = Rotation.from_euler("XYZ", own.astype(np.float64)).as_quat()
        np.testing.assert_array_equal(rotations.quaternions_from_euler(own), expected)


#: Functions with the shapes of their arguments; quaternions are the arguments of size 4 and 7.
FUNCTIONS: list[tuple[Callable[..., Any], tuple[tuple[int, ...], ...]]] = [
    (compute_dot_products, ((5, 3), (5, 3))),
    (compute_lengths, ((5, 3),)),
    (rotations.normalize_quaternions, ((5, 4),)),
    (rotations.multiply_quaternions, ((5, 4), (5, 4))),
    (rotations.conjugate_quaternions, ((5, 4),)),
    (rotations.rotate_points, ((5, 4), (5, 3))),
    (poses.transform_points, ((5, 1, 7), (5, 6, 3))),
    (poses.compose, ((5, 7), (7,))),
    (poses.invert_pose, ((5, 7),)),
    (poses.inverse_transform_points, ((5, 1, 7), (5, 6, 3))),
    (rotations.quaternions_from_euler, ((5, 3),)),
    (rotations.find_nearest_euler_branch, ((5, 3), (5, 3))),
    (rotations.matrices_from_quaternions, ((5, 4),)),
    (rotations.quaternions_from_rotation_vectors, ((5, 3),)),
    (rotations.rotation_vectors_from_quaternions, ((5, 4),)),
    (rotations.compute_rotation_magnitudes, ((5, 4),)),
    (rotations.euler_from_quaternions, ((5, 4),)),
]


@pytest.mark.parametrize(("function", "shapes"), FUNCTIONS, ids=lambda one: getattr(one, "__name__", ""))
def test_tensors_give_the_results_of_arrays(function: Callable[..., Any], shapes: tuple[tuple[int, ...], ...]) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    rng = np.random.default_rng(0)
    for scale in (1e-9, 1e-4, 0.3, 0.3, 3.0, 3.0):
        arguments = [scale * rng.standard_normal(shape) for shape in shapes]
        for array in arguments:
            if array.shape[-1] in (4, 7):
                array[..., -4:] = rng.standard_normal(array[..., -4:].shape) * [scale, 1.0, 1.0, 1.0]
                array[..., -4:] /= np.linalg.norm(array[..., -4:], axis=-1, keepdims=True)
        expected, found = function(*arguments), function(*map(torch.as_tensor, arguments))
        for one, other in zip(found, expected, strict=True) if isinstance(expected, tuple) else [(found, expected)]:
            assert is_tensor(one)
            np.testing.assert_allclose(to_numpy(one), other, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-3, np.pi - 1e-9, np.pi, np.pi + 1e-3, 2.0 * np.pi])
def test_tensors_of_special_angles(angle: float) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    half = np.array([[0.6 * np.sin(angle / 2.0), 0.0, 0.8 * np.sin(angle / 2.0), np.cos(angle / 2.0)]])
    expected = rotations.rotation_vectors_from_quaternions(half)
    found = rotations.rotation_vectors_from_quaternions(torch.as_tensor(half))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # At gimbal lock, too, the angles are those of the rotation.
    for pitch in (np.pi / 2.0, -np.pi / 2.0):
        locked = torch.as_tensor(rotations.quaternions_from_euler([[angle, pitch, 0.4]]))
        turned = rotations.quaternions_from_euler(rotations.euler_from_quaternions(locked))
        assert float(abs((turned * locked).sum())) == pytest.approx(1.0, abs=1e-9)
