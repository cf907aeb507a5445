"""Examples for copying run at a small size."""

import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script

SCENES = SyntheticDataset().list_scenes("s0", "val")[:1]


@pytest.fixture(autouse=True)
def _short_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_episodes(monkeypatch, 2500)


@pytest.mark.slow
def test_own_receiver(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = script("own_receiver", monkeypatch)
    report = example.main(example.Args(dataset="synthetic", scenes=SCENES, workers=1))
    assert [episode.scene_id for episode in report.episodes] == list(SCENES)
    assert "success" in capsys.readouterr().out


def test_pettingzoo_two_learners(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="needs the extra `train`")
    example = script("pettingzoo_two_learners", monkeypatch)
    learners = example.main(example.Args(dataset="synthetic", episodes=1, batch=1, max_cycles=3))
    assert set(learners) == {"giver", "receiver"}
