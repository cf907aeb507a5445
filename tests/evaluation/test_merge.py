"""Tests that merged shards equal the folder of a single evaluation, byte for byte if measured times are constant."""

import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl.cli import main
from handover_marl.datasets.splits import get_prescribed_side, list_split_scenes
from handover_marl.episode import loop as play
from handover_marl.errors import ResultsError
from handover_marl.evaluation.benchmark import select_shard
from tests.evaluation.demonstrations.recording import record
from tests.evaluation.quick import SHORT, QuickReceiver
from tests.helpers.equality import read_files
from tests.helpers.short_episodes import shorten_episodes

#: Options of a small split with short episodes, which take little time.
SPLIT = {"setup": "s0", "split": "val", "dataset": "synthetic", "physics": "fast", "world_config": SHORT}
OPTIONS: dict[str, Any] = {**SPLIT, "receiver": QuickReceiver, "workers": 1, "progress": False}
SCENES = (9, 14, 19, 24)


@pytest.fixture(autouse=True, scope="module")
def _times_stand_still() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play, "time", SimpleNamespace(perf_counter=lambda: 0.0))
        yield


def run(out: Path, **options: Any) -> handover_marl.Report:
    return handover_marl.evaluate_pair("noisy", out=out, **{**OPTIONS, "scenes": SCENES, **options})


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the folders of three shards of chosen scenes; do not write to them."""
    folders = [tmp_path_factory.mktemp("shards") / str(number) for number in (1, 2, 3)]
    for number, folder in enumerate(folders, 1):
        run(folder, shard=f"{number}/3")
    return folders


@pytest.mark.slow
def test_the_merged_folder_is_that_of_one_run(shards: list[Path], tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    merged = handover_marl.merge([shards[2], shards[0], shards[1]], tmp_path / "merged")
    assert read_files(tmp_path / "merged") == read_files(tmp_path / "whole")
    assert str(merged) == str(whole)
    assert len(read_files(tmp_path / "merged")) == 5 + len(SCENES)
    # The merged folder is resumed like that of a single evaluation.
    assert run(tmp_path / "merged").n_resumed == len(SCENES)


@pytest.mark.slow
def test_a_whole_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands merge the shards of a whole split; the report states that a result is missing."""
    shorten_episodes(monkeypatch, 20)
    command = ["evaluate-pair", "--setup", "s0", "--split", "val", "--dataset", "synthetic", "--physics", "fast"]
    command += ["--receiver", "hold", "--workers", "1", "--no-progress"]
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    whole = capsys.readouterr().out.rpartition("\nReport: ")[0]
    folders = [str(tmp_path / str(number)) for number in (1, 2)]
    for number, folder in enumerate(folders, 1):
        assert main([*command, "--shard", f"{number}/2", "--out", folder]) == 0
    capsys.readouterr()
    gone = sorted(Path(folders[1]).glob("*.npz"))[3]
    gone.rename(tmp_path / "aside")
    assert main(["merge", *folders, "--out", str(tmp_path / "partial")]) == 0
    assert re.search(r"val, (\d+) of (\d+) scenes \(partial\)", capsys.readouterr().out)
    (tmp_path / "aside").rename(gone)
    assert main(["merge", *folders, "--out", str(tmp_path / "merged")]) == 0
    assert capsys.readouterr().out.rpartition("\nResults: ")[0] == whole
    assert read_files(tmp_path / "merged") == read_files(tmp_path / "whole")


@pytest.mark.slow
def test_folders_that_do_not_fit_are_refused(shards: list[Path], tmp_path: Path) -> None:
    def check(message: str, *folders: Path, out: Path = tmp_path / "out") -> None:
        with pytest.raises(ResultsError, match=message):
            handover_marl.merge(folders, out)

    check(r"are of the same scene; leave one shard out", *shards, shutil.copytree(shards[1], tmp_path / "twice"))
    run(tmp_path / "other", shard="2/3", seed=1)
    check(r"different evaluations: seed '0' in .*, '1' in", shards[0], tmp_path / "other", shards[2])
    before = read_files(shards[0])
    check("is not empty; choose another output folder", *shards, out=shards[0])
    assert read_files(shards[0]) == before
    linked = shutil.copytree(shards[1], tmp_path / "linked")
    (linked / "episodes").mkdir()
    (tmp_path / "secret").write_text("of this machine")
    (linked / "episodes" / "009.html").symlink_to(tmp_path / "secret")
    check(r"009\.html is not a file in the result folder", shards[0], linked, shards[2])
    assert not (tmp_path / "out").exists()


def merge_two(evaluate: Callable[..., Any], folder: Path, **options: Any) -> Any:
    """Check that two merged shards equal an evaluation without shards, and return the merged result."""
    whole = evaluate(out=folder / "whole", **options)
    parts = [folder / "1", folder / "2"]
    for number, part in enumerate(parts, 1):
        evaluate(out=part, shard=f"{number}/2", **options)
    merged = handover_marl.merge(parts, folder / "merged")
    assert str(merged).replace("merged", "whole") == str(whole)
    assert read_files(folder / "merged") == read_files(folder / "whole")
    return merged


@pytest.mark.slow
def test_cross_play(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    options = {**OPTIONS, "scenes": SCENES[:2], "givers": ["replay", "noisy"], "receivers": ["hold", QuickReceiver]}
    del options["receiver"]
    merge_two(handover_marl.crossplay, tmp_path, **options)
    table = tmp_path / "1" / "crossplay.csv"
    text = table.read_text()
    for changed in ("a,b\n" + text, text[: text.rindex("noisy")], text.splitlines()[0]):
        table.write_text(changed)
        with pytest.raises(ResultsError, match=r"crossplay\.csv: not a cross-play table"):
            handover_marl.merge([tmp_path / "1", tmp_path / "2"], tmp_path / "again")
    table.write_text(text)
    next((tmp_path / "1" / "noisy-hold").glob("*.npz")).unlink()
    with pytest.raises(ResultsError, match="has no result files"):
        handover_marl.merge([tmp_path / "1", tmp_path / "2"], tmp_path / "again")
    shutil.copy(next((tmp_path / "2" / "noisy-hold").glob("*.npz")), tmp_path / "1" / "noisy-hold")
    with pytest.raises(ResultsError, match="not all pairs have results of the same scenes"):
        handover_marl.merge([tmp_path / "1"], tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.slow
def test_demonstrations(tmp_path: Path) -> None:
    merged = merge_two(record, tmp_path, giver="noisy")
    assert isinstance(merged, handover_marl.Demonstrations)
    assert [episode["scene_id"] for episode in merged.read_metadata()] == [5, 105]


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
    """Shards of different machines can be merged, and each has several objects."""
    scenes = list_split_scenes("s0", "test", get_prescribed_side)
    assert select_shard("1/3", range(12)) == (0, 2, 4, 9)
    assert select_shard("3/16", scenes)[:3] == (214, 264, 284)
    for count in (6, 9, 18):
        objects = Counter(scene // 5 % 20 for scene in select_shard(f"1/{count}", scenes))
        assert len(objects) >= min(6, len(scenes) // count - 2)
