"""Tests of the training scripts with a few steps on synthetic scenes."""

import csv
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl import givers, receivers
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.envs.rewards import SHAPED
from handover_marl.errors import ResultsError, UnknownNameError
from handover_marl.learning.imitation.vision.views import ViewRenderer
from handover_marl.learning.training.run_folder import open_run_folder
from handover_marl.policies.reference import parse_policy
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import QUICK_REACTIVE, REWARDS, evaluate_hold, files, script

sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")


SMALL: dict[str, Any] = {"dataset": "synthetic", "num_envs": 1, "val_scenes": 1}
GIVER = {**SMALL, "agent": "giver", "partner": "hold", "physics": "fast", "batch_size": 2, "eval_interval": 4}
RECEIVER = {**SMALL, "batch_size": 8, "time_limit": 0.6, "eval_interval": 16, "rewards": REWARDS}
MADE = {"arguments.json", "policy.npz", "checkpoint.zip", "progress.csv", "tensorboard"}


def read_column(file: Path, name: str) -> list[str]:
    with file.open(newline="") as stream:
        return [row[name] for row in csv.DictReader(stream)]


@pytest.fixture(autouse=True)
def _short_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let episodes be no longer than those of the trainings; a giver acts after 2 s."""
    shorten_episodes(monkeypatch, 2800)


@pytest.mark.slow
def test_train_giver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_sb3", monkeypatch)
    args = {**GIVER, "out": str(tmp_path / "run"), "time_limit": 3.0}
    train.main(train.Args(**args, decisions=2))
    assert files(tmp_path / "run") == MADE
    givers.make(f"learned:{tmp_path / 'run' / 'policy.npz'}")
    with pytest.raises(ResultsError, match=r"other arguments \(seed\)"):
        train.main(train.Args(**args, decisions=4, seed=5, resume=True))
    before = sb3.PPO.load(tmp_path / "run" / "checkpoint.zip", device="cpu").get_parameters()
    monkeypatch.setattr(sb3.PPO, "train", lambda model: None)
    train.main(train.Args(**args, decisions=4, resume=True))
    after = sb3.PPO.load(tmp_path / "run" / "checkpoint.zip", device="cpu")
    assert after.num_timesteps == 4
    for name, value in before["policy"].items():
        np.testing.assert_array_equal(after.get_parameters()["policy"][name], value)
    assert "4" in read_column(tmp_path / "run" / "progress_2.csv", "time/total_timesteps")


@pytest.mark.slow
def test_train_receiver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_sb3", monkeypatch)
    own = "tests.learning.custom"
    args = {**RECEIVER, "out": str(tmp_path / "run"), "action_scheme": f"{own}:FirstJoint"}
    args["features"] = f"{own}:OffsetAndCount"
    train.main(train.Args(**args, decisions=16))
    assert files(tmp_path / "run") == MADE
    terms = [*SHAPED.receiver, "approach"]
    means = [read_column(tmp_path / "run" / "progress.csv", f"rewards/{term}") for term in terms]
    assert any(float(mean) for means_of_term in means for mean in means_of_term if mean)
    train.main(train.Args(**args, decisions=24, resume=True))
    successes = read_column(tmp_path / "run" / "progress_16.csv", "evaluation/success")
    assert [float(value) for value in successes if value] == [0.0]
    parse_policy("receiver", f"learned:{tmp_path / 'run' / 'policy.npz'}", trust=True).make(SyntheticDataset())


def test_runs_are_not_resumed_on_another_dataset(
    tmp_path: Path, fake_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run with the dataset "auto" is not resumed if an environment variable now selects another dataset."""
    train = script("train_sb3", monkeypatch)
    args = train.Args(
        setup="s0",
        features="close",
        action_scheme="grasp_servo",
        partner="replay",
        out=str(tmp_path / "run"),
        resume=True,
    )
    open_run_folder(tmp_path / "run", args, False, "synthetic")
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(fake_data))
    with pytest.raises(ResultsError, match=r"other arguments \(dataset\)"):
        train.main(args)


@pytest.mark.slow
def test_a_wrong_name_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_sb3", monkeypatch)
    with pytest.raises(UnknownNameError, match="did you mean"):
        train.main(train.Args(**RECEIVER, features="clos", out=str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_train_vision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    train = script("train_vision", monkeypatch)
    monkeypatch.setattr(train, "ViewRenderer", functools.partial(ViewRenderer, reactive=QUICK_REACTIVE))
    evaluated = evaluate_hold(monkeypatch)
    few = {"dataset": "synthetic", "updates": 2, "views": 2, "batch_size": 8, "stride": 400, "workers": 1}
    few["extra_datasets"] = ("generated:n=30,seed=7,procedural=0",)
    out = tmp_path / "run"
    weights = train.main(train.Args(out=str(out), val_scenes=1, **few))
    assert files(out) == {"arguments.json", "vision.npz", "latest.npz", "checkpoint.pt", "tensorboard", "views"}
    assert weights == out / "vision.npz"
    assert len(list((out / "views").glob("*.npz"))) == 2, "of synthetic scenes"
    assert len(list((out / "views").glob("generated-*/*.npz"))) == 1
    assert evaluated == ["latest.npz"]
    assert receivers.make(f"vision:weights={weights}", SyntheticDataset()).label.startswith("vision@")
    train.main(train.Args(out=str(out), val_scenes=1, resume=True, **few))
    assert len(evaluated) == 1
