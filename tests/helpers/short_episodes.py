"""Shorter episodes, for tests of programs that only have to run."""

from dataclasses import replace
from typing import Any

import pytest

from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.episode.episode import Episode


def shorten_episodes(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    """Let single episodes in this process time out after `steps` physics steps, 1 ms each."""
    create = Episode.__init__

    def create_short(
        episode: Episode, physics: str = "exact", config: WorldConfig = OFFICIAL_CONFIG, *args: Any, **options: Any
    ) -> None:
        protocol = replace(config.protocol, horizon_steps=min(steps, config.protocol.horizon_steps))
        create(episode, physics, replace(config, protocol=protocol), *args, **options)

    monkeypatch.setattr(Episode, "__init__", create_short)
