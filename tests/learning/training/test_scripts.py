"""Tests of the training scripts with a few steps on synthetic scenes."""

import csv
import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from handover_marl import evaluate_pair, givers, receivers
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.envs.rewards import SHAPED
from handover_marl.errors import OptionError, ResultsError
from handover_marl.learning.imitation import run
from handover_marl.learning.imitation.vision.grasp_labels import GraspLabelConfig
from handover_marl.learning.imitation.vision.view_files import ViewDatasetConfig
from handover_marl.learning.training.run_folder import open_run_folder
from handover_marl.policies.reference import parse_policy
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig
from tests.learning.training.scripts import REWARDS, files, script
from tests.short_episodes import shorten_episodes

pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")


GIVER: dict[str, Any] = {
    "receiver": "hold",
    "dataset": "synthetic",
    "num_envs": 1,
    "batch_size": 4,
    "demonstrations": 2,
    "imitation_epochs": 2,
    "eval_interval": 4,
    "val_scenes": 1,
    "time_limit": 3.0,
}
RECEIVER: dict[str, Any] = {
    "dataset": "synthetic",
    "physics": "fast",
    "num_envs": 1,
    "eval_interval": 16,
    "val_scenes": 1,
    "time_limit": 3.0,
    "batch_size": 8,
}
MADE = {"arguments.json", "policy.npz", "checkpoint.pt", "progress.csv", "tensorboard"}


def read_column(file: Path, name: str) -> list[str]:
    with file.open(newline="") as stream:
        return [row[name] for row in csv.DictReader(stream)]


@pytest.fixture(autouse=True)
def _short_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the episodes of evaluations be no longer than those of the trainings."""
    shorten_episodes(monkeypatch, 3000)


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate training environments in this process; `test_train_receiver` covers those in other processes."""
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env", reason="needs the extra `train`")
    monkeypatch.setattr("handover_marl.learning.training.stable_baselines.SubprocVecEnv", vec_env.DummyVecEnv)


@pytest.mark.usefixtures("one_process")
def test_train_giver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_giver_sb3", monkeypatch)
    args = {**GIVER, "out": str(tmp_path / "run")}
    train.main(train.Args(**args, decisions=4))
    assert files(tmp_path / "run") == MADE
    givers.make(f"learned:{tmp_path / 'run' / 'policy.npz'}")
    with pytest.raises(ResultsError, match="holds a run; pass --resume"):
        train.main(train.Args(**args, decisions=8))
    with pytest.raises(ResultsError, match=r"other arguments \(seed\)"):
        train.main(train.Args(**args, decisions=8, seed=5, resume=True))
    train.main(train.Args(**args, decisions=8, resume=True))
    assert "8" in read_column(tmp_path / "run" / "progress_4.csv", "time/total_timesteps")


@pytest.mark.parametrize("physics", ["fast", "mujoco"])
def test_train_receiver(physics: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if physics == "mujoco":
        pytest.importorskip("mujoco", reason="needs MuJoCo")
    train = script("train_receiver_sb3", monkeypatch)
    own = "tests.learning.encodings.custom"
    args = {**RECEIVER, "out": str(tmp_path / "run"), "physics": physics, "rewards": REWARDS, "time_limit": 0.6}
    args |= {"features": f"{own}:OffsetAndCount", "actions": f"{own}:FirstJoint"}
    train.main(train.Args(**args, decisions=16))
    assert files(tmp_path / "run") == MADE
    terms = [*SHAPED.receiver, "approach"]
    means = [read_column(tmp_path / "run" / "progress.csv", f"rewards/{term}") for term in terms]
    assert any(float(mean) for means_of_term in means for mean in means_of_term if mean)
    train.main(train.Args(**args, decisions=24, resume=True))
    successes = read_column(tmp_path / "run" / "progress_16.csv", "evaluation/success")
    assert [float(value) for value in successes if value] == [0.0]
    parse_policy("receiver", f"learned:{tmp_path / 'run' / 'policy.npz'}", trust=True).make(SyntheticDataset())


def test_batches_smaller_than_the_environments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_giver_sb3", monkeypatch)
    with pytest.raises(OptionError, match="batch_size must be at least the number of environments, 8, got 4"):
        train.Args(**GIVER | {"num_envs": 8})


@pytest.mark.parametrize("name", ["train_giver_sb3", "train_receiver_sb3"])
def test_runs_are_not_resumed_on_another_dataset(
    tmp_path: Path, fake_data: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A run with the dataset "auto" is not resumed if an environment variable now selects another dataset."""
    train = script(name, monkeypatch)
    args = train.Args(setup="s0", out=str(tmp_path / "run"), resume=True)
    open_run_folder(tmp_path / "run", args, False, "synthetic")
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(fake_data))
    with pytest.raises(ResultsError, match=r"other arguments \(dataset\)"):
        train.main(args)


def test_train_vision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    train = script("train_vision", monkeypatch)
    trials = GraspPreparationConfig(tilts=(), lateral_offsets=(), release_offsets=(), advances=())
    labels = GraspLabelConfig(receiver=ReactiveConfig(preparation=trials))
    monkeypatch.setattr(train, "ViewDatasetConfig", functools.partial(ViewDatasetConfig, labels=labels))
    evaluated = []

    def evaluate_hold(config: Any, execution: Any) -> Any:
        """Evaluate `hold`, whose episodes take less time; the trained network acts in the rollouts of round 1."""
        evaluated.append(Path(config.receiver[1]["weights"]).name)
        return evaluate_pair(replace(config, receiver="hold"), execution=execution)

    monkeypatch.setattr(run, "evaluate_pair", evaluate_hold)
    few = {"dataset": "synthetic", "updates": 4, "rounds": 1, "views": 4, "round_views": 2, "stride": 400, "workers": 1}
    few["extra_datasets"] = ("generated:n=30,seed=7,procedural=0",)
    out = tmp_path / "run"
    weights = train.main(train.Args(out=str(out), val_scenes=1, **few))
    assert files(out) == {"arguments.json", "vision.npz", "latest.npz", "checkpoint.pt", "tensorboard", "views"}
    assert weights == out / "vision.npz"
    rounds = [out / "views" / name for name in ("round_0", "round_1")]
    assert [len(list(folder.glob("*.npz"))) for folder in rounds] == [2, 1], "of synthetic scenes"
    assert [len(list(folder.glob("generated-*/*.npz"))) for folder in rounds] == [1, 1]
    assert evaluated == ["latest.npz"] * 2
    assert receivers.make(f"vision:weights={weights}", SyntheticDataset()).label.startswith("vision@")
    with pytest.raises(ResultsError, match="--resume"):
        train.main(train.Args(out=str(out), val_scenes=1, **few))
    train.main(train.Args(out=str(out), val_scenes=1, resume=True, **few))
    assert len(evaluated) == 2
