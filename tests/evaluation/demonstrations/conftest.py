"""Fixtures of the tests of recordings in both formats."""

from typing import Any

import pytest

from handover_marl.evaluation import episode_runner


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The scenes that this process plays from now on."""
    scenes: list[int] = []
    play = episode_runner.EpisodeRunner.run

    def noted(player: Any, task: Any) -> Any:
        scenes.append(task.scene_id)
        return play(player, task)

    monkeypatch.setattr(episode_runner.EpisodeRunner, "run", noted)
    return scenes
