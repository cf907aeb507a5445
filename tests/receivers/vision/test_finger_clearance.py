import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handover_marl.geometry.poses import compose, transform_points
from handover_marl.receivers.vision.finger_clearance import FingerGeometry, shift_to_avoid_collisions

Array = NDArray[np.float64]

FINGERS = FingerGeometry()
STRAIGHT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def bar(width: float, offset: float = 0.0, near: float = 0.08) -> Array:
    """Return points on the near side of a box of a width along y, at z = `near` (m)."""
    across, along = np.meshgrid(np.linspace(-0.02, 0.02, 9), np.linspace(offset - width / 2, offset + width / 2, 41))
    return np.stack([across.ravel(), along.ravel(), np.full(across.size, near)], axis=1)


def test_fitting_object_needs_no_shift() -> None:
    grasps, costs = shift_to_avoid_collisions(STRAIGHT[None], bar(0.07))
    np.testing.assert_array_equal(grasps, STRAIGHT[None])
    np.testing.assert_array_equal(costs, 0.0)


@pytest.mark.parametrize(("offset", "shift"), [(0.01, 0.006), (-0.01, -0.006), (0.016, 0.012), (0.022, 0.018)])
def test_asymmetric_object_shifts_the_grasp(offset: float, shift: float) -> None:
    grasps, costs = shift_to_avoid_collisions(STRAIGHT[None], bar(0.066, offset))
    np.testing.assert_allclose(grasps[0, :3], [0.0, shift, 0.0])
    np.testing.assert_allclose(costs, FINGERS.shift_cost * abs(shift))


def test_wide_object_costs_by_depth() -> None:
    shallow, deep = (shift_to_avoid_collisions(STRAIGHT[None], bar(0.1, near=near))[1][0] for near in (0.1, 0.06))
    assert deep - shallow == pytest.approx(FINGERS.collision_cost * 0.04)
    assert shallow > 0.3


def test_points_beyond_the_fingers_are_ignored() -> None:
    beside = bar(0.2)[:, [1, 0, 2]] + np.array([0.0, 0.047, 0.0])
    beside = beside[np.abs(beside[:, 0]) > FINGERS.half_width]
    for points in (bar(0.2, near=0.115), beside, np.zeros((0, 3))):
        grasps, costs = shift_to_avoid_collisions(STRAIGHT[None], points)
        np.testing.assert_array_equal(grasps, STRAIGHT[None])
        assert costs[0] == 0.0
    assert shift_to_avoid_collisions(np.zeros((0, 7)), bar(0.05))[0].shape == (0, 7)


@given(seed=st.integers(0, 2**16), offset=st.floats(-0.02, 0.02))
@settings(max_examples=30)
def test_shift_is_invariant_to_the_frame(seed: int, offset: float) -> None:
    # Whether a finger hits a point exactly on its side depends on the rounding of the transformation.
    distances = np.abs(np.subtract.outer(bar(0.07, offset)[:, 1], FINGERS.lateral_shifts))
    assume(np.abs(np.subtract.outer(distances, (FINGERS.inner_y, FINGERS.outer_y))).min() > 1e-12)
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=3), Rotation.random(random_state=seed).as_quat()])
    here, cost = shift_to_avoid_collisions(STRAIGHT[None], bar(0.07, offset))
    there, same = shift_to_avoid_collisions(pose[None], transform_points(pose, bar(0.07, offset)))
    np.testing.assert_allclose(there[0, :3], compose(pose, here[0])[:3], atol=1e-9)
    np.testing.assert_allclose(same, cost, atol=1e-6)
