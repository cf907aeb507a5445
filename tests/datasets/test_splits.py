from handover_marl.datasets.splits import SPLIT_SIZES, SPLITS, list_split_scenes


def no_side(scene_id: int) -> str:
    raise AssertionError(f"asked for the side of scene {scene_id}")


def test_official_sizes_and_scenes_of_splits() -> None:
    found = {
        (setup, split): list_split_scenes(setup, split, no_side) for setup in ("s0", "s1", "s3") for split in SPLITS
    }
    assert {key: len(scenes) for key, scenes in found.items()} == {key: SPLIT_SIZES[key] for key in found}
    assert found["s0", "val"][:2] == (9, 14)
    assert found["s3", "test"][:2] == (35, 36)
    assert found["s1", "test"][0] == 705


def test_s2_depends_on_the_side_of_the_last_trial_only() -> None:
    asked = []

    def side(scene_id: int) -> str:
        asked.append(scene_id)
        return "left"

    assert len(list_split_scenes("s2", "test", side)) == 8 * 18 * 3
    assert all(scene % 5 == 4 for scene in asked)
