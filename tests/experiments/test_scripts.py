"""Tests of examples for copying at a small size."""

import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script


@pytest.mark.slow
def test_own_receiver(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shorten_episodes(monkeypatch, 2500)
    example, scenes = script("own_receiver", monkeypatch), SyntheticDataset().list_scenes("s0", "val")[:1]
    found = example.main(example.Args(dataset="synthetic", scenes=scenes, workers=1))
    assert [episode.scene_id for episode in found.episodes] == list(scenes)
    assert "success" in capsys.readouterr().out
