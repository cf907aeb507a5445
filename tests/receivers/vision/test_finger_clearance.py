import numpy as np
import pytest
from numpy.typing import NDArray

from handover_marl.receivers.vision.grasp_tracker import COLLISION_COST, SHIFT_COST, shift_to_avoid_collisions

Array = NDArray[np.float64]

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
    np.testing.assert_allclose(costs, SHIFT_COST * abs(shift))


def test_wide_object_costs_by_depth() -> None:
    shallow, deep = (shift_to_avoid_collisions(STRAIGHT[None], bar(0.1, near=near))[1][0] for near in (0.1, 0.06))
    assert deep - shallow == pytest.approx(COLLISION_COST * 0.04)
    assert shallow > 0.3
