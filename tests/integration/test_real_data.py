"""Tests of the loader on the real data."""

import pytest

from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES, SPLITS


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("split", SPLITS)
def test_splits_have_the_official_sizes(real_dataset: OfficialDataset, setup: str, split: str) -> None:
    assert len(real_dataset.list_scenes(setup, split)) == SPLIT_SIZES[setup, split]


def test_every_scene_is_complete(real_dataset: OfficialDataset) -> None:
    real_dataset.check_scenes(tuple(range(1000)))


@pytest.mark.parametrize("scene_id", [0, 128, 552, 988])
def test_scene_motion(real_dataset: OfficialDataset, scene_id: int) -> None:
    scene = real_dataset.load_scene(scene_id)
    assert scene.object_dof.shape == (scene.n_frames, 1, 6)
    assert scene.object_dof[:, 0, 2].min() > 0.9
    assert scene.hand_first is not None
    assert scene.hand_last is not None
    assert not scene.hand_dof[: scene.hand_first].any()
    assert scene.hand_dof[scene.hand_first : scene.hand_last + 1].any(axis=1).all()


def test_grasps_exist_for_all_but_the_largest_objects(real_dataset: OfficialDataset) -> None:
    for number in range(1, 20):
        name = real_dataset.load_info(5 * number).target_name
        grasps = real_dataset.load_grasps(name)
        assert (grasps is None) == (name == "036_wood_block"), name
