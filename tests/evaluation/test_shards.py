"""Tests that shards in one folder equal a single evaluation, byte for byte if measured times are constant."""

import csv
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl.datasets.splits import get_prescribed_side, list_split_scenes
from handover_marl.episode import loop as play
from handover_marl.errors import ResultsError
from handover_marl.evaluation.benchmark import select_shard
from handover_marl.evaluation.reports.report import load_report
from tests.evaluation.demonstrations.recording import record
from tests.evaluation.quick import SHORT, QuickReceiver
from tests.helpers.equality import read_files

#: Options of a small split with short episodes, which take little time.
SPLIT = {"setup": "s0", "split": "val", "dataset": "synthetic", "physics": "fast", "world_config": SHORT}
OPTIONS: dict[str, Any] = {**SPLIT, "receiver": QuickReceiver, "workers": 1, "progress": False}
SCENES = (9, 14, 19, 24)


@pytest.fixture(autouse=True, scope="module")
def _times_stand_still() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play, "time", SimpleNamespace(perf_counter=lambda: 0.0))
        yield


def play_shards(evaluate: Callable[..., Any], folder: Path, **options: Any) -> Any:
    """Check that two shards in one folder, and the same call without a shard, equal an evaluation; return it."""
    evaluate(out=folder / "whole", **options)
    for number in (2, 1):
        evaluate(out=folder / "shards", shard=f"{number}/2", **options)
    result = evaluate(out=folder / "shards", **options)
    expected, found = (read_files(folder / name) for name in ("whole", "shards"))
    assert found.keys() == expected.keys()
    # Reports say that the episodes come from an earlier run.
    data = [name for name in expected if Path(name).suffix in (".csv", ".npz", ".yaml")]
    assert {name: found[name] for name in data} == {name: expected[name] for name in data}
    return result


@pytest.mark.slow
def test_shards_in_one_folder_are_one_evaluation(tmp_path: Path) -> None:
    options = {**OPTIONS, "giver": "noisy", "scenes": SCENES}
    assert play_shards(handover_marl.evaluate_pair, tmp_path, **options).n_resumed == len(SCENES)
    assert str(load_report(tmp_path / "shards")) == str(load_report(tmp_path / "whole"))
    with pytest.raises(ResultsError, match=r"holds another evaluation \(seed '0' in the folder, '1' now"):
        handover_marl.evaluate_pair(out=tmp_path / "shards", shard="1/2", seed=1, **options)


@pytest.mark.slow
def test_cross_play(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    options = {key: value for key, value in OPTIONS.items() if key != "receiver"} | {"scenes": SCENES[:2]}
    options |= {"givers": ["replay", "noisy"], "receivers": [QuickReceiver]}
    play_shards(handover_marl.crossplay, tmp_path, **options)
    rows = csv.DictReader((tmp_path / "shards" / "crossplay.csv").read_text().splitlines())
    pairs = {(row["giver"], row["receiver"]) for row in rows}
    assert pairs == {("replay", "quick"), ("noisy", "quick")}


@pytest.mark.slow
def test_demonstrations(tmp_path: Path) -> None:
    found = play_shards(record, tmp_path, giver="noisy")
    assert isinstance(found, handover_marl.Demonstrations)
    assert [episode["scene_id"] for episode in found.read_metadata()] == [5, 105]


@given(st.sets(st.integers(0, 999), min_size=1, max_size=300), st.data())
def test_shards_are_disjoint_complete_and_of_about_equal_size(chosen: set[int], data: st.DataObject) -> None:
    scenes = tuple(sorted(chosen))
    count = data.draw(st.integers(1, len(scenes)))
    parts = [select_shard(f"{number}/{count}", scenes) for number in range(1, count + 1)]
    assert sorted(scene for part in parts for scene in part) == list(scenes)
    assert all(list(part) == sorted(part) for part in parts)
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1


def test_scenes_of_a_shard_are_stable_and_mixed() -> None:
    """Shards of different machines fit together, and each has several objects."""
    scenes = list_split_scenes("s0", "test", get_prescribed_side)
    assert select_shard("1/3", range(12)) == (0, 2, 4, 9)
    assert select_shard("3/16", scenes)[:3] == (214, 264, 284)
    for count in (6, 9, 18):
        objects = Counter(scene // 5 % 20 for scene in select_shard(f"1/{count}", scenes))
        assert len(objects) >= min(6, len(scenes) // count - 2)
