"""Fixtures for the tests of recordings."""

from typing import Any

import pytest

from handover_marl.evaluation import episode_runner


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which the number of every scene that this process simulates is added."""
    scenes: list[int] = []
    play = episode_runner.EpisodeRunner.run

    def noted(player: Any, task: Any) -> Any:
        scenes.append(task.scene_id)
        return play(player, task)

    monkeypatch.setattr(episode_runner.EpisodeRunner, "run", noted)
    return scenes
