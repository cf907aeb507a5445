import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import compose, compose_point
from handover_marl.receivers.vision.finger_room import Fingers, passing

Array = NDArray[np.float64]

FINGERS = Fingers()
STRAIGHT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def bar(width: float, aside: float = 0.0, near: float = 0.08) -> Array:
    """Points of a box's near side, so wide along y, from `near` on along z, in the hand link's frame."""
    across, along = np.meshgrid(np.linspace(-0.02, 0.02, 9), np.linspace(aside - width / 2, aside + width / 2, 41))
    return np.stack([across.ravel(), along.ravel(), np.full(across.size, near)], axis=1)


def test_what_fits_between_the_fingers_is_left_as_it_is() -> None:
    grasps, prices = passing(STRAIGHT[None], bar(0.07))
    np.testing.assert_array_equal(grasps, STRAIGHT[None])
    np.testing.assert_array_equal(prices, 0.0)


@pytest.mark.parametrize(("aside", "moved"), [(0.01, 0.006), (-0.01, -0.006), (0.016, 0.012), (0.022, 0.018)])
def test_what_sticks_out_on_one_side_moves_the_grasp_there(aside: float, moved: float) -> None:
    grasps, prices = passing(STRAIGHT[None], bar(0.066, aside))
    np.testing.assert_allclose(grasps[0, :3], [0.0, moved, 0.0])
    np.testing.assert_allclose(prices, FINGERS.moving * abs(moved))


def test_what_is_too_wide_costs_by_how_deep_it_reaches_into_the_way() -> None:
    shallow, deep = (passing(STRAIGHT[None], bar(0.1, near=near))[1][0] for near in (0.1, 0.06))
    assert deep - shallow == pytest.approx(FINGERS.hitting * 0.04)
    assert shallow > 0.3


def test_what_is_behind_the_tips_or_beside_the_fingers_is_no_hindrance() -> None:
    beside = bar(0.2)[:, [1, 0, 2]] + np.array([0.0, 0.047, 0.0])
    beside = beside[np.abs(beside[:, 0]) > FINGERS.half]
    for points in (bar(0.2, near=0.115), beside, np.zeros((0, 3))):
        grasps, prices = passing(STRAIGHT[None], points)
        np.testing.assert_array_equal(grasps, STRAIGHT[None])
        assert prices[0] == 0.0
    assert passing(np.zeros((0, 7)), bar(0.05))[0].shape == (0, 7)


@given(seed=st.integers(0, 2**16), aside=st.floats(-0.02, 0.02))
@settings(max_examples=30, deadline=None)
def test_it_is_the_same_wherever_the_grasp_is(seed: int, aside: float) -> None:
    rng = np.random.default_rng(seed)
    place = np.concatenate([rng.normal(size=3), Rotation.random(random_state=seed).as_quat()])
    here, price = passing(STRAIGHT[None], bar(0.07, aside))
    there, same = passing(place[None], compose_point(place, bar(0.07, aside)))
    np.testing.assert_allclose(there[0, :3], compose(place, here[0])[:3], atol=1e-9)
    np.testing.assert_allclose(same, price, atol=1e-6)
