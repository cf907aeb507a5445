import pytest

from handover_marl.datasets.splits import SPLIT_SIZES, SPLITS, list_split_scenes


def no_side(scene_id: int) -> str:
    raise AssertionError(f"asked for the side of scene {scene_id}")


@pytest.mark.parametrize("setup", ["s0", "s1", "s3"])
@pytest.mark.parametrize("split", SPLITS)
def test_official_sizes_of_splits(setup: str, split: str) -> None:
    assert len(list_split_scenes(setup, split, no_side)) == SPLIT_SIZES[setup, split]


def test_s2_depends_on_the_side_of_the_last_trial_only() -> None:
    asked = []

    def side(scene_id: int) -> str:
        asked.append(scene_id)
        return "left"

    scenes = list_split_scenes("s2", "test", side)
    assert all(scene % 5 == 4 for scene in asked)
    assert len(scenes) == 8 * 18 * 3


def test_known_scenes_of_splits() -> None:
    assert list_split_scenes("s0", "val", no_side)[:2] == (9, 14)
    assert list_split_scenes("s3", "test", no_side)[:2] == (35, 36)
    assert list_split_scenes("s1", "test", no_side)[0] == 705
