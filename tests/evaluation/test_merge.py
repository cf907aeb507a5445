"""Tests that merged shards equal the folder of a single evaluation, byte for byte if measured times are constant."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

import handover_marl
from handover_marl.cli import main
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.episode import loop as play
from handover_marl.errors import ResultsError
from handover_marl.evaluation import benchmark
from handover_marl.evaluation.results import read_results
from tests.evaluation.quick import SHORT, QuickReceiver

#: Options of a small split with short episodes, which take little time.
SPLIT = {"setup": "s0", "split": "val", "dataset": "synthetic", "physics": "fast", "world_config": SHORT}
OPTIONS: dict[str, Any] = {**SPLIT, "receiver": QuickReceiver, "workers": 1, "progress": False}
SCENES = (9, 14, 19, 24, 29)
VERY_SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=100))


@pytest.fixture(autouse=True)
def _times_stand_still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play, "time", SimpleNamespace(perf_counter=lambda: 0.0))


def contents(folder: Path) -> dict[str, bytes]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def shards(folder: Path, count: int, **options: Any) -> list[Path]:
    """Evaluate all shards of a pair of policies, and return their folders."""
    for number in range(1, count + 1):
        out = folder / str(number)
        handover_marl.evaluate_pair("noisy", out=out, shard=f"{number}/{count}", **{**OPTIONS, **options})
    return [folder / str(number) for number in range(1, count + 1)]


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the folders of three shards of chosen scenes; do not write to them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play, "time", SimpleNamespace(perf_counter=lambda: 0.0))
        return shards(tmp_path_factory.mktemp("three"), 3, scenes=SCENES)


@pytest.mark.slow
def test_the_merged_folder_is_that_of_one_run(three: list[Path], tmp_path: Path) -> None:
    whole = handover_marl.evaluate_pair("noisy", out=tmp_path / "whole", scenes=SCENES, **OPTIONS)
    merged = handover_marl.merge([three[2], three[0], three[1]], tmp_path / "merged")
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")
    assert str(merged) == str(whole)
    assert len(contents(tmp_path / "merged")) == 5 + len(SCENES)
    # The merged folder is resumed like that of a single evaluation.
    more = handover_marl.evaluate_pair("noisy", out=tmp_path / "merged", scenes=SCENES, **OPTIONS)
    assert more.n_resumed == len(SCENES)


def test_folders_store_their_shard(three: list[Path]) -> None:
    reported = yaml.safe_load((three[1] / "config.yaml").read_text())["HANDOVER_MARL"]["shard"]
    assert reported == "2/3 of 9,14,19,24,29"
    assert "(partial, shard 2/3)" in (three[1] / "report.md").read_text()
    found = sorted(result.scene_id or 0 for folder in three for result in read_results(folder))
    assert found == list(SCENES)
    with pytest.raises(ResultsError, match=r"another evaluation \(shard '2/3 of 9,14,19,24,29' in the folder, '1/3 of"):
        handover_marl.evaluate_pair("noisy", out=three[1], scenes=SCENES, shard="1/3", **OPTIONS)


@pytest.mark.slow
def test_a_whole_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands merge the shards of a whole split, and refuse to do so while a result is missing."""
    resolve = benchmark.resolve_config
    monkeypatch.setattr(
        benchmark, "resolve_config", lambda config, trust: resolve(replace(config, world_config=VERY_SHORT), trust)
    )
    command = ["pair", "--setup", "s0", "--split", "val", "--dataset", "synthetic", "--physics", "fast"]
    command += ["--receiver", "hold", "--workers", "1", "--no-progress"]
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    whole = capsys.readouterr().out.rpartition("\nReport: ")[0]
    folders = [str(tmp_path / str(number)) for number in (1, 2)]
    for number, folder in enumerate(folders, 1):
        assert main([*command, "--shard", f"{number}/2", "--out", folder]) == 0
    capsys.readouterr()
    gone = sorted(Path(folders[1]).glob("*.npz"))[3]
    gone.rename(tmp_path / "aside")
    assert main(["merge", *folders, "--out", str(tmp_path / "merged")]) == 2
    assert f"1 scenes have no result ({gone.name}); run the commands of all 2 shards" in capsys.readouterr().err
    (tmp_path / "aside").rename(gone)
    assert main(["merge", *folders, "--out", str(tmp_path / "merged")]) == 0
    assert capsys.readouterr().out.rpartition("\nResults: ")[0] == whole
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")


def test_missing_scenes_are_reported_and_nothing_is_written(three: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    missing = sorted(result.scene_id or 0 for result in read_results(three[1]))
    listed = ", ".join(f"scene {scene}" for scene in missing)
    with pytest.raises(ResultsError, match=rf"not all shards.*: {len(missing)} scenes have no result \({listed}\)"):
        handover_marl.merge([three[0], three[2]], out)
    half = tmp_path / "half"
    shutil.copytree(three[0], half)
    next(half.glob("*.npz")).unlink()
    with pytest.raises(ResultsError, match="1 scenes have no result"):
        handover_marl.merge([half, *three[1:]], out)
    assert not out.exists()


@pytest.mark.slow
def test_folders_of_different_evaluations_are_refused(three: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    twice = shutil.copytree(three[1], tmp_path / "twice")
    with pytest.raises(ResultsError, match=r"are of the same scene; leave one shard out"):
        handover_marl.merge([*three, twice], out)
    for change, reported in (
        ({"seed": 1}, r"different evaluations: seed '0' in .*, '1' in"),
        ({"receiver": "hold"}, r"different evaluations: receiver 'quick' in .*; receiver hash"),
        ({"scenes": [9, 14, 19, 24]}, r"different scenes were selected"),
        ({"shard": "2/2"}, "different evaluations: 3 shards and 2"),
    ):
        other = tmp_path / f"other {sorted(change)}"
        options = {**OPTIONS, "scenes": SCENES, "shard": "2/3", **change}
        handover_marl.evaluate_pair("noisy", out=other, **options)
        with pytest.raises(ResultsError, match=reported):
            handover_marl.merge([three[0], other, three[2]], out)
    whole = tmp_path / "whole"
    handover_marl.evaluate_pair("noisy", out=whole, scenes=SCENES, **OPTIONS)
    with pytest.raises(ResultsError, match="is not a shard: it was evaluated without --shard"):
        handover_marl.merge([whole], tmp_path / "elsewhere")
    with pytest.raises(ResultsError, match="is one of the shards"):
        handover_marl.merge(three, three[0])
    with pytest.raises(ResultsError, match="holds another evaluation"):
        handover_marl.merge(three, tmp_path / "other ['seed']")
    assert not out.exists()


@pytest.mark.slow
def test_cross_play(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    options = {**OPTIONS, "scenes": SCENES[:2]}
    del options["receiver"]
    played = (["replay", "noisy"], ["hold", QuickReceiver])
    whole = handover_marl.crossplay(*played, out=tmp_path / "whole", **options)
    parts = [tmp_path / "1", tmp_path / "2"]
    for number, part in enumerate(parts, 1):
        handover_marl.crossplay(*played, out=part, shard=f"{number}/2", **options)
    merged = handover_marl.merge(parts, tmp_path / "merged")
    assert str(merged) == str(whole)
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")
    table = parts[1] / "crossplay.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:-1]))
    with pytest.raises(ResultsError, match=r"shards of different cross-plays: .* have other pairs"):
        handover_marl.merge(parts, tmp_path / "again")
    table = parts[0] / "crossplay.csv"
    table.write_text("a,b\n" + table.read_text())
    with pytest.raises(ResultsError, match=r"crossplay\.csv: not a cross-play table"):
        handover_marl.merge(parts, tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.slow
def test_agreement(tmp_path: Path) -> None:
    options = {**OPTIONS, "scenes": SCENES[:2]}
    del options["physics"]
    whole = handover_marl.compare_physics(out=tmp_path / "whole", **options)
    parts = [tmp_path / "1", tmp_path / "2"]
    for number, part in enumerate(parts, 1):
        handover_marl.compare_physics(out=part, shard=f"{number}/2", **options)
    assert str(handover_marl.merge(parts, tmp_path / "merged")) == str(whole)
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")


@pytest.mark.slow
def test_demonstrations(tmp_path: Path) -> None:
    from tests.evaluation.demonstrations.recording import record

    scenes = (5, 105, 205)
    whole = record(None, tmp_path / "whole", scenes=scenes, giver="noisy")
    parts = [tmp_path / "1", tmp_path / "2"]
    for number, part in enumerate(parts, 1):
        record(None, part, scenes=scenes, giver="noisy", shard=f"{number}/2")
    merged = handover_marl.merge(parts, tmp_path / "merged")
    assert isinstance(merged, handover_marl.Demonstrations)
    assert str(merged).replace("merged", "whole") == str(whole)
    assert [episode["scene_id"] for episode in merged.read_metadata()] == list(scenes)
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")


def test_links_out_of_a_folder_are_not_followed(three: list[Path], tmp_path: Path) -> None:
    copies = [shutil.copytree(path, tmp_path / path.name) for path in three]
    (copies[1] / "episodes").mkdir()
    page = copies[1] / "episodes" / "009.html"
    (tmp_path / "secret").write_text("of this machine")
    page.symlink_to(tmp_path / "secret")
    with pytest.raises(ResultsError, match=r"009\.html is not a file in the result folder"):
        handover_marl.merge(copies, tmp_path / "merged")
    assert not (tmp_path / "merged").exists()
