"""Tests of the training of a giver that chooses its offer."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from handover_marl import EpisodeStatus, givers
from tests.learning.training.scripts import script
from tests.short_episodes import shorten_episodes

torch = pytest.importorskip("torch", reason="needs the extra `train`")


@pytest.fixture(name="train")
def _train(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return script("train_giver_offers", monkeypatch)


def test_critics_and_actor_learn_which_offers_succeed(train: ModuleType) -> None:
    """Offers succeed where the first output has the sign of the first feature, and faster with a large second one."""
    rng = np.random.default_rng(0)
    features = rng.standard_normal((4000, 3)).astype(np.float32)
    outputs = rng.uniform(-1, 1, (4000, 2)).astype(np.float32)
    success = features[:, 0] * outputs[:, 0] > 0
    status = np.where(success, EpisodeStatus.SUCCESS, EpisodeStatus.OBJECT_DROP).astype(int)
    steps = 6500 - 3000 * outputs[:, 1]
    offers = train.Offers(features, outputs, status, steps, np.zeros(4000, int), np.arange(4000))
    args = train.Args(updates=300, critics=2, width=32)
    torch.manual_seed(0)
    critics = train.Critics(3, 2, args)
    optimizer = torch.optim.Adam(critics.parameters(), 3e-3)
    assert train.update(critics, optimizer, offers, args, 0) < 0.25
    actor = train.train_actor(critics, offers, args)
    chosen = actor(torch.as_tensor(features)).detach().numpy().clip(-1, 1)
    decided = abs(features[:, 0]) > 0.3
    assert (features[decided, 0] * chosen[decided, 0] > 0).mean() > 0.95
    assert chosen[:, 1].mean() > 0.5


@pytest.mark.slow
def test_a_run_continues_and_writes_a_policy(
    train: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 2800)
    small = {"dataset": "synthetic", "receivers": ("hold",), "num_envs": 2, "round_episodes": 2, "workers": 1}
    options = {**small, "updates": 2, "candidates": 4, "val_scenes": 0, "out": tmp_path / "run"}
    train.main(train.Args(**options, episodes=2))
    path = train.main(train.Args(**options, episodes=4, resume=True))
    givers.make(f"learned:{path}")
    with np.load(tmp_path / "run" / "offers.npz") as stored:
        assert stored["features"].shape == (4, 39)
        assert stored["outputs"].shape == (4, 7)
        assert abs(stored["outputs"]).max() <= 1
        # The second part of the run has environments with other seeds.
        assert (stored["features"][:2] != stored["features"][2:]).any()
