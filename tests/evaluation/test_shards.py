from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.datasets.splits import get_prescribed_side, list_split_scenes
from handover_marl.errors import OptionError
from handover_marl.evaluation.benchmark import select_shard


@given(st.sets(st.integers(0, 999), min_size=1, max_size=300), st.data())
def test_shards_are_disjoint_complete_and_of_about_equal_size(chosen: set[int], data: st.DataObject) -> None:
    scenes = tuple(sorted(chosen))
    count = data.draw(st.integers(1, len(scenes)))
    shards = [select_shard(f"{number}/{count}", scenes) for number in range(1, count + 1)]
    assert sorted(scene for shard in shards for scene in shard) == list(scenes)
    assert all(list(shard) == sorted(shard) for shard in shards)
    sizes = [len(shard) for shard in shards]
    assert max(sizes) - min(sizes) <= 1


def test_scenes_of_a_shard_are_stable_and_mixed() -> None:
    """Shards of different machines can be merged, and each has several objects."""
    scenes = list_split_scenes("s0", "test", get_prescribed_side)
    assert select_shard("1/3", range(12)) == (0, 2, 4, 9)
    assert select_shard("3/16", scenes)[:3] == (214, 264, 284)
    for count in (6, 9, 18):
        objects = Counter(scene // 5 % 20 for scene in select_shard(f"1/{count}", scenes))
        assert len(objects) >= min(6, len(scenes) // count - 2)


@pytest.mark.parametrize(
    ("shard", "message"),
    [
        *((shard, "shard must be a number and a count") for shard in ("", "3", "0/4", "5/4", " 1/4", "1/4 of 9", 3)),
        ("2/3", "shard 2/3 needs 3 scenes or more, got 2; take fewer shards"),
    ],
)
def test_invalid_shards(shard: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        select_shard(shard, [9, 14])
