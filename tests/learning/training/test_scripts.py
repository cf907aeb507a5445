"""Tests of the training scripts with a few steps on synthetic scenes."""

import functools
from pathlib import Path

import pytest

from handover_marl import receivers
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ResultsError
from handover_marl.learning.imitation.vision.views import ViewRenderer
from handover_marl.learning.training.run_folder import open_run_folder
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import QUICK_REACTIVE, evaluate_hold, files, script

sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")


def test_runs_are_not_resumed_on_another_dataset(
    tmp_path: Path, fake_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run with the dataset "auto" is not resumed if an environment variable now selects another dataset."""
    train = script("train_vision", monkeypatch)
    args = train.Args(setup="s0", out=str(tmp_path / "run"), resume=True)
    open_run_folder(tmp_path / "run", args, False, "synthetic")
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(fake_data))
    with pytest.raises(ResultsError, match=r"other arguments \(dataset,"):
        train.main(args)


@pytest.mark.slow
def test_train_vision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    train = script("train_vision", monkeypatch)
    monkeypatch.setattr(train, "ViewRenderer", functools.partial(ViewRenderer, reactive=QUICK_REACTIVE))
    evaluated = evaluate_hold(monkeypatch)
    shorten_episodes(monkeypatch, 500)
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
