"""Tests of folders of training runs: resuming, and damaged files."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError, ResultsError
from handover_marl.learning.training.learning_curve import CurvePoint
from handover_marl.learning.training.run_folder import (
    RunFolder,
    describe_origin,
    select_held_out_scenes,
    select_training_scenes,
)


@dataclass(frozen=True)
class Args:
    out: str = "runs/test"
    data_dir: str | None = None
    dataset: str = "auto"
    decisions: int = 10
    minutes: float = 1.0
    seed: int = 0
    rates: tuple[float, ...] = (0.1, 0.2)
    resume: bool = False


POINT = CurvePoint(8, 1.5, 3, 0.5, 0.1, 0.9, 0.25, 0.125, 0.125, "synthetic", "fast", "replay")


def started(path: Path, points: int = 2) -> RunFolder:
    pytest.importorskip("matplotlib", reason="needs the extra `plot`")
    folder = RunFolder(path, Args(), False, "synthetic")
    for number in range(points):
        folder.add(replace(POINT, steps=8 * number, seconds=1.5 * number))
    return folder


def resumed(path: Path, **changes: object) -> RunFolder:
    return RunFolder(path, replace(Args(), resume=True, **changes), True, "synthetic")


def test_resumed_run_keeps_its_points(tmp_path: Path) -> None:
    first = started(tmp_path / "a" / "run")
    again = resumed(tmp_path / "a" / "run", decisions=99, minutes=9.0, data_dir="elsewhere")
    assert again.points == first.points
    assert again.seconds == 1.5
    assert first.path / "policy.npz" == again.policy
    assert first.path / "checkpoint.pt" == again.checkpoint


def test_summary_names_the_unit_of_the_steps() -> None:
    assert POINT.summarize("gradient updates").startswith("8 gradient updates, 0.0 min: success 50.0%")


def test_new_folder_can_be_resumed(tmp_path: Path) -> None:
    assert resumed(tmp_path / "new").points == []
    assert resumed(tmp_path / "new").seconds == 0.0


def test_other_runs_are_not_overwritten(tmp_path: Path) -> None:
    started(tmp_path / "run")
    with pytest.raises(ResultsError, match="holds a run; pass --resume"):
        RunFolder(tmp_path / "run", Args(), False, "synthetic")
    with pytest.raises(ResultsError, match=r"other arguments \(rates, seed\)"):
        resumed(tmp_path / "run", seed=3, rates=(0.1,))
    arguments = json.loads((tmp_path / "run" / "arguments.json").read_text())
    assert (arguments["seed"], arguments["rates"]) == (0, [0.1, 0.2])


def test_run_is_resumed_on_its_dataset_only(tmp_path: Path) -> None:
    """A run is not resumed on another dataset, even if the argument "auto" is the same."""
    RunFolder(tmp_path / "run", Args(), False, "synthetic")
    with pytest.raises(ResultsError, match=r"other arguments \(dataset\)"):
        RunFolder(tmp_path / "run", Args(resume=True), True, "dexycb")
    RunFolder(tmp_path / "run", Args(resume=True, dataset="synthetic"), True, "synthetic")


@dataclass(frozen=True)
class RenamedArgs:
    eval_interval: int = 512
    num_envs: int = 8
    use_groups: bool = False
    expert: str = "GraspExpertConfig(candidates=24, pads=(0.1, 0.2))"


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2]", b"null", b'"text"', b"\xff\xfe\x00", b"[" * 100_000])
def test_damaged_arguments_are_refused(tmp_path: Path, content: bytes) -> None:
    path = started(tmp_path / "run", 1).path / "arguments.json"
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=r"arguments\.json: not the arguments of a run .*choose another --out"):
        resumed(tmp_path / "run")
    assert path.read_bytes() == content


def test_arguments_that_are_a_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run" / "arguments.json").mkdir(parents=True)
    with pytest.raises(ResultsError, match=r"arguments\.json: not the arguments of a run"):
        resumed(tmp_path / "run")


HEADER = "steps,seconds,episodes,success,low,high,contact,drop,timeout,dataset,physics,partner\n"


@pytest.mark.parametrize(
    "content",
    [
        "steps\n8\n",
        HEADER + "8,1.5\n",
        HEADER + "8,soon,3,0.5,0.1,0.9,0.25,0.125,0.125,synthetic,fast,replay\n",
        HEADER + "8.5,1.5,3,0.5,0.1,0.9,0.25,0.125,0.125,synthetic,fast,replay\n",
        HEADER + "8,1.5,3,0.5,0.1,0.9,0.25,0.125,0.125,synthetic,fast,replay,more\n",
        HEADER.replace("\n", ",more\n") + "8,1.5,3,0.5,0.1,0.9,0.25,0.125,0.125,synthetic,fast,replay,3\n",
        HEADER.replace("partner", "friend") + "8,1.5,3,0.5,0.1,0.9,0.25,0.125,0.125,synthetic,fast,replay\n",
        HEADER + '"' + 200_000 * "8" + '"\n',
        "",
        "\x00\x01\x02",
        "hello\n",
        "\udcff\udcfe\n\udcff",
    ],
)
def test_damaged_curves_are_refused(tmp_path: Path, content: str) -> None:
    path = started(tmp_path / "run").path / "learning_curve.csv"
    path.write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(ResultsError, match=r"learning_curve\.csv: not a learning curve of this library"):
        resumed(tmp_path / "run")


def test_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("hello")
    with pytest.raises(ResultsError, match="cannot make"):
        started(tmp_path / "run", 0)


def test_every_tenth_scene_is_held_out() -> None:
    scenes = tuple(range(100, 200))
    assert set(select_training_scenes(scenes)) | set(select_held_out_scenes(scenes)) == set(scenes)
    assert not set(select_training_scenes(scenes)) & set(select_held_out_scenes(scenes))
    assert select_scenes_evenly(scenes, 3) in ((100, 150, 199), (100, 149, 199), (100, 150, 199))
    assert select_scenes_evenly(scenes, 1000) == scenes
    with pytest.raises(OptionError, match="of at least 1, got 0"):
        select_scenes_evenly(scenes, 0)


def test_origin_has_arguments_but_no_paths() -> None:
    text = describe_origin("train", Args(out="/home/me", data_dir="/secret", seed=7))
    assert text.startswith("experiments/training/train.py ")
    assert "seed=7" in text
    assert "/home/me" not in text
    assert "/secret" not in text
