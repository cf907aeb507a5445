from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.datasets.splits import SPLIT_SIZES, get_prescribed_side, list_split_scenes
from handover_marl.errors import OptionError
from handover_marl.evaluation.shards import Shard


@given(st.sets(st.integers(0, 999), min_size=1, max_size=300), st.data())
def test_shards_are_disjoint_complete_and_of_about_equal_size(chosen: set[int], data: st.DataObject) -> None:
    scenes = tuple(sorted(chosen))
    count = data.draw(st.integers(1, len(scenes)))
    shards = [Shard(number, count).select(scenes) for number in range(1, count + 1)]
    assert sorted(scene for shard in shards for scene in shard) == list(scenes)
    assert all(list(shard) == sorted(shard) for shard in shards)
    sizes = [len(shard) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    assert shards == [Shard.parse(f"{number}/{count}").select(list(scenes)) for number in range(1, count + 1)]


def test_scenes_of_a_shard_are_stable() -> None:
    """The scenes of a shard never change, so that shards of different machines and versions can be merged."""
    assert Shard(1, 3).select(range(12)) == (0, 2, 4, 9)
    assert Shard(3, 16).select(list_split_scenes("s0", "test", get_prescribed_side))[:3] == (214, 264, 284)


def test_shards_are_mixed() -> None:
    """Every shard has several objects, although every n-th scene of a split may have the same object."""
    scenes = list_split_scenes("s0", "test", get_prescribed_side)
    for count in (6, 9, 18):
        objects = Counter(scene // 5 % 20 for scene in Shard(1, count).select(scenes))
        assert len(objects) >= min(6, len(scenes) // count - 2)


@pytest.mark.parametrize(
    "text", ["", "3", "0/4", "5/4", "-1/4", "1/0", "1/4/2", " 1/4", "one/two", "1/4 of 9", None, 3]
)
def test_invalid_shards(text: str) -> None:
    with pytest.raises(OptionError, match="shard must be a number and a count"):
        Shard.parse(text)


def test_more_shards_than_scenes() -> None:
    with pytest.raises(OptionError, match=r"shard 2/3 needs 3 scenes or more, got 2; take fewer shards"):
        Shard(2, 3).select([9, 14])


@given(st.integers(1, 20), st.data())
def test_text_of_a_shard_is_parsed_again(count: int, data: st.DataObject) -> None:
    number = data.draw(st.integers(1, count))
    scenes = data.draw(st.none() | st.sets(st.integers(0, 999), min_size=count).map(lambda few: tuple(sorted(few))))
    shard = Shard(number, count, scenes)
    assert Shard.parse(str(shard), with_scenes=True) == shard
    n_scenes = SPLIT_SIZES["s0", "val"] if scenes is None else len(scenes)
    assert shard.list_positions(SPLIT_SIZES["s0", "val"]) == shard.select(range(n_scenes))


@pytest.mark.parametrize("text", ["", "3/4 of", "3/4 of 9,", "5/4", "3/4 of a", "3/4 of 12345678"])
def test_invalid_shards_with_scenes(text: str) -> None:
    with pytest.raises(OptionError):
        Shard.parse(text, with_scenes=True)
