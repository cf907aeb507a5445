"""Fixtures for the tests of evaluations."""

from typing import Any

import pytest

from handover_marl.evaluation.episode_runner import EpisodeRunner


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which the number of every scene that this process simulates is added."""
    scenes: list[int] = []
    run = EpisodeRunner.run

    def noted(runner: Any, task: Any) -> Any:
        scenes.append(task.scene_id)
        return run(runner, task)

    monkeypatch.setattr(EpisodeRunner, "run", noted)
    return scenes
