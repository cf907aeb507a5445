"""Tests of the planner against the plan of the original planner in HandoverSim's demonstration of scene 105."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.datasets import OfficialDataset
from handover_marl.episode.episode import Episode
from handover_marl.receivers.omg import OmgReceiver

WAYPOINTS, TAIL = 30, 5


@pytest.mark.slow
def test_goal_set_holds_the_goal_of_the_original(real_dataset: OfficialDataset, recordings: Path) -> None:
    receiver = receivers.make("omg", real_dataset)
    assert isinstance(receiver, OmgReceiver)
    episode = Episode("fast")
    episode.reset(real_dataset.load_scene(105))
    receiver.reset()
    episode.advance(receiver.act(episode.observe()), 3000)
    receiver.act(episode.observe())
    episode.close()
    assert receiver.plan is not None
    tail = _demonstration(recordings)[-TAIL:]
    nearest = np.abs(receiver.plan.goals.tails - tail).max(axis=(1, 2)).min()
    assert nearest < 1e-4


def _demonstration(recordings: Path) -> np.ndarray:
    """Return the waypoints (30, 7) of the demonstration's approach (rad)."""
    with np.load(recordings / "scene105_demo.npz") as recorded:
        actions = recorded["action"]
    changes = np.flatnonzero(np.abs(np.diff(actions, axis=0)).max(axis=1) > 1e-7) + 1
    waypoints: np.ndarray = actions[changes[:WAYPOINTS], :7]
    return waypoints
