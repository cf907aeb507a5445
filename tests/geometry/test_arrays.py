"""Tests of functions that take NumPy arrays and PyTorch tensors: both results must agree."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.geometry import poses, rotations
from handover_marl.geometry.arrays import (
    NUMPY_ARRAYS,
    as_arrays,
    get_namespace,
    is_tensor,
    make_tensor_factory,
    to_numpy,
)

torch = pytest.importorskip("torch", reason="needs the extra `train`")

Array = npt.NDArray[np.float64]
#: Functions with the shapes of their arguments; quaternions are the arguments of size 4 and 7.
FUNCTIONS: list[tuple[Callable[..., Any], tuple[tuple[int, ...], ...]]] = [
    (poses.compute_dot_products, ((5, 3), (5, 3))),
    (poses.compute_lengths, ((5, 3),)),
    (poses.normalize_quaternions, ((5, 4),)),
    (poses.multiply_quaternions, ((5, 4), (5, 4))),
    (poses.conjugate_quaternions, ((5, 4),)),
    (poses.rotate_points, ((5, 4), (5, 3))),
    (poses.transform_points, ((5, 1, 7), (5, 6, 3))),
    (poses.compose, ((5, 7), (7,))),
    (poses.invert_pose, ((5, 7),)),
    (poses.inverse_transform_points, ((5, 1, 7), (5, 6, 3))),
    (poses.quaternions_from_euler, ((5, 3),)),
    (poses.select_nearest_euler, ((5, 3), (5, 3))),
    (rotations.matrices_from_quaternions, ((5, 4),)),
    (rotations.quaternions_from_rotation_vectors, ((5, 3),)),
    (rotations.rotation_vectors_from_quaternions, ((5, 4),)),
    (rotations.compute_rotation_magnitudes, ((5, 4),)),
    (rotations.euler_from_quaternions, ((5, 4),)),
]


def draw_arguments(shapes: tuple[tuple[int, ...], ...], seed: int, scale: float) -> list[Array]:
    rng = np.random.default_rng(seed)
    arguments = [scale * rng.standard_normal(shape) for shape in shapes]
    for array in arguments:
        if array.shape[-1] in (4, 7):
            array[..., -4:] = rng.standard_normal(array[..., -4:].shape) * [scale, 1.0, 1.0, 1.0]
            array[..., -4:] /= np.linalg.norm(array[..., -4:], axis=-1, keepdims=True)
    return arguments


@pytest.mark.parametrize(("function", "shapes"), FUNCTIONS, ids=lambda one: getattr(one, "__name__", ""))
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-9, 1e-4, 0.3, 3.0]))
@settings(max_examples=10, deadline=None)
def test_tensors_give_the_results_of_arrays(
    function: Callable[..., Any], shapes: tuple[tuple[int, ...], ...], seed: int, scale: float
) -> None:
    arguments = draw_arguments(shapes, seed, scale)
    expected, found = function(*arguments), function(*map(torch.as_tensor, arguments))
    parts = zip(found, expected, strict=True) if isinstance(expected, tuple) else [(found, expected)]
    for one, other in parts:
        assert is_tensor(one)
        np.testing.assert_allclose(to_numpy(one), other, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-3, np.pi - 1e-9, np.pi, np.pi + 1e-3, 2.0 * np.pi])
def test_rotation_vectors_at_special_angles(angle: float) -> None:
    quaternion = np.array([[0.6 * np.sin(angle / 2.0), 0.0, 0.8 * np.sin(angle / 2.0), np.cos(angle / 2.0)]])
    expected = rotations.rotation_vectors_from_quaternions(quaternion)
    found = rotations.rotation_vectors_from_quaternions(torch.as_tensor(quaternion))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(
        rotations.quaternions_from_rotation_vectors(found), rotations.quaternions_from_rotation_vectors(expected)
    )


@pytest.mark.parametrize("pitch", [np.pi / 2.0, -np.pi / 2.0])
def test_euler_angles_at_gimbal_lock_are_those_of_the_rotation(pitch: float) -> None:
    quaternion = torch.as_tensor(poses.quaternions_from_euler([[0.3, pitch, 0.4]]))
    angles = rotations.euler_from_quaternions(quaternion)
    turned = poses.quaternions_from_euler(angles)
    assert float(abs((turned * quaternion).sum())) == pytest.approx(1.0, abs=1e-9)


def test_namespaces_follow_the_arguments() -> None:
    array, tensor = np.zeros(3), torch.zeros(3)
    assert get_namespace(array) is NUMPY_ARRAYS.xp
    assert get_namespace(array, tensor) is make_tensor_factory("cpu").xp
    _, first, second = as_arrays(tensor, [1.0, 2.0, 3.0])
    assert is_tensor(first)
    assert second.tolist() == [1.0, 2.0, 3.0]
