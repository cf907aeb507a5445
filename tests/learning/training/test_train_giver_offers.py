"""Tests of the training of a giver that chooses its offer."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl import EpisodeStatus, givers
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script, simulate_here

torch = pytest.importorskip("torch", reason="needs the extra `train`")


@pytest.mark.slow
def test_the_network_learns_which_offers_succeed_and_how_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offers succeed where the first two features have the same sign, and faster with a large third one."""
    train = script("train_giver_offers", monkeypatch)
    rng = np.random.default_rng(0)
    features = rng.standard_normal((4000, 3)).astype(np.float32)
    success = features[:, 0] * features[:, 1] > 0
    status = np.where(success, EpisodeStatus.SUCCESS, EpisodeStatus.OBJECT_DROP).astype(int)
    steps = 6500 - 2000 * features[:, 2].clip(-2, 2)
    offers = train.Offers(features, status, steps, np.zeros(4000, int), np.arange(4000))
    network = train.fit(offers, train.Args(updates=400, width=32, dropout=0.0), 0)
    outputs = network(features)
    decided = abs(features[:, :2]).min(axis=1) > 0.3
    assert ((outputs[decided, 0] > 0) == success[decided]).mean() > 0.95
    errors = outputs[success, 1] - steps[success] / 13000
    assert abs(errors).mean() < 0.05
    ablated = train.fit(offers, train.Args(updates=20, width=32, ignored=(0,)), 0)
    assert (ablated(features) == ablated(features * np.float32([9.0, 1.0, 1.0]))).all()


@pytest.mark.slow
def test_a_run_continues_and_writes_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_giver_offers", monkeypatch)
    shorten_episodes(monkeypatch, 2800)
    simulate_here(monkeypatch)
    small = {"dataset": "synthetic", "receivers": ("hold",), "num_envs": 2, "round_episodes": 2, "workers": 1}
    options = {**small, "updates": 2, "candidates": (2,), "val_scenes": 0, "out": tmp_path / "run"}
    train.main(train.Args(**options, episodes=2))
    path = train.main(train.Args(**options, episodes=4, resume=True))
    givers.make(f"adaptive:weights={path}")
    with np.load(tmp_path / "run" / "offers.npz") as stored:
        assert stored["features"].shape == (4, 48)
        assert abs(stored["features"][:, 41:]).max() <= 1
        # The second part of the run has environments with other seeds.
        assert (stored["features"][:2] != stored["features"][2:]).any()
