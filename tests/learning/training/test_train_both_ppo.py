"""Tests of the training of both agents in plain PyTorch."""

from pathlib import Path
from types import ModuleType

import pytest

from handover_marl.learning.policy_files import read_policy
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script, simulate_here

pytest.importorskip("torch", reason="needs the extra `train`")


@pytest.fixture(name="train")
def _train(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return script("train_both_ppo", monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("critic", ["own", "both"])
def test_a_training_writes_both_policies_and_repeats_from_its_seed(
    train: ModuleType, critic: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shorten_episodes(monkeypatch, 1000)
    simulate_here(monkeypatch)
    small = {"num_envs": 2, "batch_size": 8, "minibatch_size": 4, "decisions": 8, "val_scenes": 1, "workers": 1}
    written = []
    for name in "ab" if critic == "both" else "a":
        train.main(train.Args(dataset="synthetic", critic=critic, out=str(tmp_path / name), **small))
        written.append([(tmp_path / name / f"{agent}.npz").read_bytes() for agent in ("giver", "receiver")])
    assert written[0] == written[-1]
    assert "8 decisions: success" in capsys.readouterr().out
    spec, network, _ = read_policy(tmp_path / "a" / "giver.npz", "giver")
    assert (spec.features, spec.actions) == ("giver", "offer")
    assert network.n_inputs == 39
