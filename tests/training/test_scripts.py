"""The training scripts do what they say, on a few steps of synthetic scenes."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from handover_marl import givers, receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ResultsError
from handover_marl.training.run_folder import held_out_scenes, spread_scenes, training_scenes

pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
EXPERIMENTS = Path(__file__).parents[2] / "experiments"
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    spec = importlib.util.spec_from_file_location(name, EXPERIMENTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


GIVER: dict[str, Any] = {
    "receiver": "hold",
    "dataset": "synthetic",
    "envs": 1,
    "batch": 4,
    "demonstrations": 4,
    "passes": 2,
    "every": 4,
    "val_scenes": 2,
    "time_limit": 3.0,
}
RECEIVER: dict[str, Any] = {
    "dataset": "synthetic",
    "envs": 1,
    "every": 16,
    "val_scenes": 2,
    "time_limit": 3.0,
    "batch": 8,
}
MADE = {
    "arguments.json",
    "policy.npz",
    "checkpoint.zip",
    "learning_curve.csv",
    "learning_curve.png",
    "tensorboard",
}


def test_giver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_giver_sb3", monkeypatch)
    args = {**GIVER, "out": str(tmp_path / "run")}
    train.main(train.Args(**args, steps=4))
    assert files(tmp_path / "run") >= MADE
    rows = (tmp_path / "run" / "learning_curve.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["steps", "0", "4"]
    givers.make(f"learned:{tmp_path / 'run' / 'policy.npz'}")
    with pytest.raises(ResultsError, match="holds a run; pass --resume"):
        train.main(train.Args(**args, steps=8))
    with pytest.raises(ResultsError, match=r"other arguments \(seed\)"):
        train.main(train.Args(**args, steps=8, seed=5, resume=True))
    train.main(train.Args(**args, steps=8, resume=True))
    rows = (tmp_path / "run" / "learning_curve.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["steps", "0", "4", "8"]


def test_receiver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_receiver_sb3", monkeypatch)
    args = {**RECEIVER, "out": str(tmp_path / "run")}
    train.main(train.Args(**args, steps=16))
    assert files(tmp_path / "run") >= MADE
    train.main(train.Args(**args, steps=24, resume=True))
    receivers.make(f"learned:{tmp_path / 'run' / 'policy.npz'}", SyntheticDataset())


def test_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_both_ippo", monkeypatch)
    args = {
        "out": str(tmp_path / "run"),
        "dataset": "synthetic",
        "envs": 2,
        "rollout": 10,
        "val_scenes": 2,
        "time_limit": 1.5,
        "minibatches": 2,
        "epochs": 1,
    }
    train.main(train.Args(**args, steps=20))
    assert (MADE | {"giver.npz", "receiver.npz"}) - {"policy.npz"} <= files(tmp_path / "run")
    train.main(train.Args(**args, steps=40, resume=True))
    rows = (tmp_path / "run" / "learning_curve.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["steps", "0", "20", "40"]


def test_best_responses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    respond = script("best_response", monkeypatch)
    args = respond.Args(
        out=str(tmp_path / "run"),
        rounds=1,
        first_receiver="hold",
        dataset="synthetic",
        val_scenes=2,
        giver=respond.train_giver_sb3.Args(**GIVER, steps=4),
        receiver=respond.train_receiver_sb3.Args(**RECEIVER, steps=16),
    )
    respond.main(args)
    table = (tmp_path / "run" / "crossplay" / "crossplay.csv").read_text().splitlines()
    assert len(table) == 1 + 2 * 2


def test_scenes_are_kept_for_testing() -> None:
    scenes = tuple(range(100, 200))
    assert set(training_scenes(scenes)) | set(held_out_scenes(scenes)) == set(scenes)
    assert not set(training_scenes(scenes)) & set(held_out_scenes(scenes))
    assert spread_scenes(scenes, 3) in ((100, 150, 199), (100, 149, 199), (100, 150, 199))
    assert spread_scenes(scenes, 1000) == scenes
