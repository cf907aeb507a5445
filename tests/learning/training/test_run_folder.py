"""Tests of folders of training runs and of the choice of scenes."""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError, ResultsError, check_name
from handover_marl.learning.training.run_folder import describe_origin, open_run_folder
from handover_marl.learning.training.scene_arguments import (
    RlArgs,
    run_script,
    select_held_out_scenes,
    select_training_scenes,
)


@dataclass(frozen=True)
class Args:
    out: str = "runs/test"
    data_dir: str | None = None
    dataset: str = "auto"
    decisions: int = 10
    seed: int = 0
    rates: tuple[float, ...] = (0.1, 0.2)
    resume: bool = False


def test_only_the_same_run_is_resumed(tmp_path: Path) -> None:
    path = tmp_path / "a" / "run"
    assert open_run_folder(path, Args(), False, "synthetic") == path
    open_run_folder(path, Args(decisions=99, data_dir="elsewhere", resume=True), True, "synthetic")
    open_run_folder(path, Args(dataset="synthetic"), True, "synthetic")
    for args, resume, dataset, fault in (
        (Args(), False, "synthetic", "holds a run; pass --resume"),
        (replace(Args(), seed=3, rates=(0.1,)), True, "synthetic", r"other arguments \(rates, seed\)"),
        (Args(), True, "dexycb", r"other arguments \(dataset\)"),
    ):
        with pytest.raises(ResultsError, match=fault):
            open_run_folder(path, args, resume, dataset)
    open_run_folder(path, Args(), True, "synthetic")
    with pytest.raises(ResultsError, match="other arguments \\(expert_hash\\)"):
        open_run_folder(path, Args(), True, "synthetic", expert_hash="b")
    arguments = json.loads((path / "arguments.json").read_text())
    assert (arguments["seed"], arguments["rates"]) == (0, [0.1, 0.2])
    with pytest.raises(ResultsError, match="holds no run to continue"):
        open_run_folder(tmp_path / "none", Args(), True, "synthetic")


def test_scripts_end_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["script.py", "--out", "x"])
    with pytest.raises(SystemExit, match=r"^error: unknown out 'x'; valid: y$"):
        run_script(lambda args: check_name("out", args.out, ["y"]), Args, None)


def test_every_tenth_scene_is_held_out() -> None:
    scenes = tuple(range(100, 200))
    assert set(select_training_scenes(scenes)) | set(select_held_out_scenes(scenes)) == set(scenes)
    assert not set(select_training_scenes(scenes)) & set(select_held_out_scenes(scenes))
    assert select_training_scenes((7,)) == (7,)
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


def test_training_environments_leave_out_held_out_scenes() -> None:
    args = RlArgs(dataset="synthetic")
    all_scenes = args.open_dataset().list_scenes("s0", "train")
    assert args.env_options["scenes"] == select_training_scenes(all_scenes)
    assert len(all_scenes) > 100
