"""Tests of the collision masks of a scene's objects."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.errors import SimulationError
from handover_marl.geometry.ycb import SCENE_CLASSES
from handover_marl.simulation.bullet.bodies import HAND_MASK, TABLE_MASK, compute_object_masks


def test_masks_of_ycb_classes_are_those_of_handoversim() -> None:
    assert compute_object_masks(SCENE_CLASSES[:5]) == [2, 4, 8, 16, 32]
    assert compute_object_masks((21, 1)) == [2**20, 2]


@given(st.lists(st.integers(1, 200), min_size=1, max_size=5))
def test_no_two_objects_share_a_bit(class_ids: list[int]) -> None:
    masks = [TABLE_MASK, HAND_MASK, *compute_object_masks(class_ids)]
    assert all(mask.bit_count() == 1 and mask < 2**31 for mask in masks)
    assert len(set(masks)) == len(masks)


def test_too_many_objects() -> None:
    with pytest.raises(SimulationError, match="at most 29 objects, got 30"):
        compute_object_masks(range(22, 52))
