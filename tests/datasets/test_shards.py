from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.datasets.shards import Shard, ShardOfRun
from handover_marl.datasets.splits import SPLIT_SIZES, designed_side, split_scenes
from handover_marl.errors import OptionError


@given(st.sets(st.integers(0, 999), min_size=1, max_size=300), st.data())
def test_every_scene_is_in_one_shard_and_shards_are_alike_in_size(chosen: set[int], data: st.DataObject) -> None:
    scenes = tuple(sorted(chosen))
    count = data.draw(st.integers(1, len(scenes)))
    shards = [Shard(number, count).of(scenes) for number in range(1, count + 1)]
    assert sorted(scene for shard in shards for scene in shard) == list(scenes)
    assert all(list(shard) == sorted(shard) for shard in shards)
    sizes = [len(shard) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    assert shards == [Shard.parse(f"{number}/{count}").of(list(scenes)) for number in range(1, count + 1)]


def test_which_scenes_a_shard_has_stays() -> None:
    """Shards of different machines and days fit together."""
    assert Shard(1, 3).of(range(12)) == (0, 2, 4, 9)
    assert Shard(3, 16).of(split_scenes("s0", "test", designed_side))[:3] == (214, 264, 284)


def test_shards_are_mixed() -> None:
    """A split goes through objects in turn, so that every n-th scene could be of one object alone."""
    scenes = split_scenes("s0", "test", designed_side)
    for count in (6, 9, 18):
        objects = Counter(scene // 5 % 20 for scene in Shard(1, count).of(scenes))
        assert len(objects) >= min(6, len(scenes) // count - 2)


@pytest.mark.parametrize(
    "text", ["", "3", "0/4", "5/4", "-1/4", "1/0", "1/4/2", " 1/4", "one/two", "1/4 of 9", None, 3]
)
def test_texts_that_are_no_shards(text: str) -> None:
    with pytest.raises(OptionError, match="which of how many"):
        Shard.parse(text)


def test_more_shards_than_scenes() -> None:
    with pytest.raises(OptionError, match=r"shard 2/3: there are only 2 scenes; take 2 shards at most"):
        Shard(2, 3).of([9, 14])


@given(st.integers(1, 20), st.data())
def test_what_folders_tell_is_read_again(count: int, data: st.DataObject) -> None:
    shard = Shard(data.draw(st.integers(1, count)), count)
    scenes = data.draw(st.none() | st.sets(st.integers(0, 999), min_size=count).map(lambda few: tuple(sorted(few))))
    told = ShardOfRun(shard, scenes)
    assert ShardOfRun.parse(str(told)) == told
    n_scenes = SPLIT_SIZES["s0", "val"] if scenes is None else len(scenes)
    places = told.places("s0", "val")
    assert len(places) == len(shard.of(range(n_scenes)))
    assert all(scene is None for scene in places.values()) == (scenes is None)


@pytest.mark.parametrize("text", ["", "3/4 of", "3/4 of 9,", "5/4", "3/4 of a", "3/4 of 1234"])
def test_what_no_folder_tells(text: str) -> None:
    with pytest.raises(OptionError):
        ShardOfRun.parse(text)
