"""Tests of GA-DDPG's point cloud memory, with the random draws of the original scripts."""

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.receivers.gaddpg import GRIPPER_POINTS, PointCloudMemory

Array = npt.NDArray[np.float64]


def pose(shift: tuple[float, float, float] = (0.4, 0.1, 0.5), angle: float = 0.3) -> Array:
    """Return a hand pose (4, 4) in the base frame, rotated about z."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = shift
    return matrix


def cloud(count: int, seed: int = 0) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return rng.uniform((-0.05, -0.05, 0.2), (0.05, 0.05, 0.3), (count, 3)).astype(np.float32)


def transform_to_base(points: npt.NDArray[np.float32], base_from_hand: Array) -> Array:
    return np.asarray(base_from_hand[:3, :3] @ points.T + base_from_hand[:3, [3]], dtype=np.float64)


def make_generator() -> np.random.RandomState:
    return np.random.RandomState(123456)


@pytest.mark.parametrize(("count", "remaining", "kept"), [(2000, 20, 1024), (2000, 17, 877), (400, 17, 400)])
def test_thinning(count: int, remaining: int, kept: int) -> None:
    memory = PointCloudMemory()
    memory.remaining = remaining
    memory.update(cloud(count), pose())
    chosen = make_generator().choice(count, kept, replace=False)
    np.testing.assert_array_equal(memory.cloud, transform_to_base(cloud(count), pose())[:, chosen].astype(np.float32))
    assert len(set(chosen)) == kept


def test_network_input() -> None:
    memory = PointCloudMemory()
    memory.update(cloud(2000), pose())
    now = pose((0.42, 0.12, 0.45), 0.5)
    points = memory.make_network_input(now)
    assert points.shape == (4, 1030)
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points[3], [1.0] * 6 + [0.0] * 1024)
    np.testing.assert_array_equal(points[:3, :6], GRIPPER_POINTS)
    exact = np.linalg.inv(now)
    hand = exact[:3, :3] @ memory.cloud + exact[:3, [3]]
    np.testing.assert_allclose(points[:3, 6:], hand, atol=2e-7)
    # The inverse pose is rounded to float32, the points are not.
    rounded = np.linalg.inv(now).astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(points[:3, 6:], rounded[:3, :3] @ memory.cloud + rounded[:3, [3]], atol=1e-8)
    assert np.abs(points[:3, 6:] - hand).max() > 1e-8
    assert (points[:3, 6:] != points[:3, 6:].astype(np.float32)).any()


@pytest.mark.parametrize(
    ("corner", "axis", "sign"),
    [(0.02, 0, 1), (-0.02, 0, -1), (0.05, 1, 1), (-0.05, 1, -1), (0.11, 2, 1), (0.06, 2, -1)],
)
def test_cage_is_an_open_box(corner: float, axis: int, sign: int) -> None:
    for shift, is_caged in ((-1e-4, True), (1e-4, False)):
        points = np.tile(np.float32([0.0, 0.0, 0.085]), (1024, 1))
        points[:, axis] = corner + sign * shift
        memory = PointCloudMemory()
        memory.update(points, np.eye(4))
        assert memory.is_object_caged(np.eye(4)) == is_caged
