"""Tests of the training of a receiver by imitation."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from handover_marl import receivers
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script

torch = pytest.importorskip("torch", reason="needs the extra `train`")
pytest.importorskip("mujoco", reason="needs MuJoCo")


@pytest.fixture(name="train")
def _train(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return script("train_receiver_dagger", monkeypatch)


def test_the_network_learns_the_experts_outputs(train: ModuleType) -> None:
    rng = np.random.default_rng(0)
    features = (3.0 + 2.0 * rng.standard_normal((2000, 4))).astype(np.float32)
    outputs = np.tanh(features[:, :2] - features[:, 2:])
    network = train.fit(train.Decisions(features, outputs), train.Args(width=32, updates=1500))
    assert abs(network(features) - outputs).mean() < 0.1


@pytest.mark.slow
def test_a_run_continues_and_writes_a_policy(
    train: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 600)
    monkeypatch.setattr(train, "select_training_scenes", lambda scenes: scenes[:2])
    args = train.Args(dataset="synthetic", out=tmp_path, expert="hold", updates=2, val_scenes=0, workers=1, rounds=1)
    train.main(args)
    path = train.main(replace(args, rounds=2, resume=True))
    receivers.make(f"learned:{path}")
    for number in range(2):
        files = list((tmp_path / f"round_{number}").iterdir())
        assert len(files) == 2
        with np.load(files[0]) as stored:
            assert stored["features"].shape == (6, 70)
            # The gripper of the expert is open in all decisions.
            assert (stored["outputs"][:, -1] == -1).all()
