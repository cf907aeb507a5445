"""Tests of training with other libraries at the smallest size; the policies run without these libraries."""

from pathlib import Path
from typing import Any

import pytest

from handover_marl import givers, receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.learning.policy_files import read_policy
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script

pytest.importorskip("torch", reason="needs an extra with PyTorch")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
SCRIPTS = {"train_both_rllib": "ray.rllib", "train_both_benchmarl": "benchmarl"}
SMALL: dict[str, Any] = {
    **{"dataset": "synthetic", "decisions": 32, "batch_size": 16, "minibatch_size": 8, "epochs": 1},
    **{"num_envs": 1, "width": 8, "time_limit": 1.0, "val_scenes": 1},
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_training_writes_policies_that_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(SCRIPTS[name], reason="another library; see `make loops`")
    train = script(name, monkeypatch)
    shorten_episodes(monkeypatch, 3000)
    train.main(train.PairArgs(**SMALL, out=str(tmp_path)))
    assert "32 decisions: success" in capsys.readouterr().out
    for agent, package in (("giver", givers), ("receiver", receivers)):
        path = tmp_path / f"{agent}.npz"
        package.make(f"learned:{path}", SyntheticDataset())  # type: ignore[attr-defined]
        assert name in read_policy(path, agent)[0].origin
