"""Tests of the training of a receiver by imitation."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.execution.tasks import pickle_by_value, unpickle
from handover_marl.learning.imitation.run import join_samples, read_samples
from handover_marl.learning.policy_files import read_policy
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script

torch = pytest.importorskip("torch", reason="needs the extra `train`")


@pytest.mark.slow
def test_the_network_learns_the_experts_outputs(monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_receiver_dagger", monkeypatch)
    rng = np.random.default_rng(0)
    features = (3.0 + 2.0 * rng.standard_normal((2000, 4))).astype(np.float32)
    outputs = np.tanh(features[:, :2] - features[:, 2:])
    network = train.fit(train.Decisions(features, outputs, np.zeros(2000, bool)), train.Args(width=32, epochs=384.0))
    assert abs(network(features) - outputs).mean() < 0.1


@pytest.mark.slow
def test_a_run_continues_and_writes_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_receiver_dagger", monkeypatch)
    shorten_episodes(monkeypatch, 600)
    small = {"num_envs": 2, "batches": 2, "seconds": 0.6, "epochs": 0.1, "workers": 1, "rounds": 1}
    args = train.Args(dataset="synthetic", out=tmp_path / "a", expert="hold", val_scenes=0, **small)
    generate = train.generate_samples

    def send(kind: Any, folder: Path, numbers: Any, make: Any, *options: Any) -> Any:  # as to workers
        return generate(kind, folder, numbers, unpickle(pickle_by_value(make)), *options)

    monkeypatch.setattr(train, "generate_samples", send)
    first = train.main(args).read_bytes()
    # Batches do not depend on earlier ones of the process: the last one is simulated again, alone.
    sorted((tmp_path / "a/decisions_0").iterdir())[-1].unlink()
    (tmp_path / "a/policy_0.npz").unlink()
    assert train.main(replace(args, resume=True)).read_bytes() == first
    path = train.main(replace(args, rounds=2, resume=True))
    receivers.make(f"learned:{path}")
    written, acting = (read_policy(file, "receiver")[1] for file in (path, path.parent / "policy_1.npz"))
    np.testing.assert_allclose(acting.biases[-1] - written.biases[-1], [0.0] * 6 + [args.closing_margin], atol=1e-6)
    for number in range(2):
        parts = [read_samples(train.Decisions, file) for file in sorted((tmp_path / f"a/decisions_{number}").iterdir())]
        decisions = join_samples(parts)
        assert decisions.features.shape[1] == 70
        # In the first round the expert always acts: 2 batches, 2 environments, 6 control periods.
        assert len(decisions.outputs) == 24 if number == 0 else len(decisions.outputs) <= 24
