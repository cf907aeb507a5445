"""Tests that recorded actions reproduce the recorded episodes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl import Demonstrations
from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.loop import derive_seed
from handover_marl.episode.observations import select_receiver_observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.demonstrations.demonstration import Demonstration
from tests.evaluation.demonstrations.recording import HORIZON, SHORT, record


def assert_shows(seen: dict[str, np.ndarray], demonstration: Demonstration, number: int) -> None:
    for name, array in demonstration.observations.items():
        np.testing.assert_array_equal(array[number], seen[name], err_msg=f"{name} {number}", strict=True)


def assert_replays(
    demonstration: Demonstration, shown: Demonstrations, config: WorldConfig, obs_mode: str = "state"
) -> None:
    """Check that the actions of both agents, at their recorded steps, reproduce all observations and the outcome."""
    metadata = demonstration.metadata
    episode = Episode(metadata["physics"], config)
    episode.reset(open_dataset(metadata["dataset"]).load_scene(metadata["scene_id"]))
    episode.seed_camera(derive_seed(metadata["seed"], "camera"))
    robot = dict(zip(demonstration.steps.tolist(), demonstration.actions, strict=False))
    giver = dict(zip(demonstration.giver_steps.tolist(), demonstration.giver_actions, strict=True))
    times = sorted({*robot, *giver, metadata["steps"]})
    number, action, deviation = 0, np.zeros(9, dtype=np.float32), NO_DEVIATION
    for now, then in zip(times, [*times[1:], metadata["steps"]], strict=True):
        if now in robot or now == metadata["steps"]:
            seen = select_receiver_observation(episode.observe(), episode.observe_camera(obs_mode), obs_mode)
            assert shown.observation_space.contains(seen)
            assert_shows(seen, demonstration, number)
            number, action = number + 1, robot.get(now, action)
        deviation = giver.get(now, deviation)
        episode.advance(action, then - now, deviation)
    assert number == len(demonstration) + 1
    assert (int(episode.status), episode.steps) == (metadata["status"], metadata["steps"])
    assert (-1 if episode.release_step is None else episode.release_step) == metadata["release_step"]
    episode.close()


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_actions_replay_an_episode_of_the_replayed_giver(tmp_path: Path, physics: str) -> None:
    (demonstration,) = demonstrations = record(None, tmp_path / "out", physics=physics, scenes=[5])
    holds = np.diff(demonstration.steps)
    assert len(set(holds)) > 3
    assert (demonstration.steps[0], demonstration.steps[-1]) == (0, HORIZON)
    assert demonstration.truncations.tolist() == [False] * (len(holds) - 1) + [True]
    assert not demonstration.terminations.any()
    assert demonstration.giver_actions.shape == (0, 8)
    assert_replays(demonstration, demonstrations, SHORT)


def test_both_agents_and_the_camera_are_replayed(tmp_path: Path) -> None:
    demonstrations = record(None, tmp_path / "out", giver="noisy", obs_mode="state+pointcloud", seed=3)
    for demonstration in demonstrations:
        assert len(demonstration.giver_steps) > 3
        assert len(np.unique(demonstration.giver_actions, axis=0)) > 3
        assert set(demonstration.giver_steps) != set(demonstration.steps[:-1])
        # Decisions are recorded at the receiver's own intervals; actions of the giver add none.
        assert all(50 <= hold < 150 for hold in np.diff(demonstration.steps)[:-1])
        assert_replays(demonstration, demonstrations, SHORT, "state+pointcloud")
    # The camera sees more than 1024 points, of which 1024 are drawn at random.
    assert demonstrations[0].observations["wrist_point_counts"].max() > 1024


@pytest.mark.slow
def test_reward_of_a_success_is_that_of_the_environment(tmp_path: Path) -> None:
    options: dict[str, Any] = {"receiver": "yang2021:wait=0", "world_config": OFFICIAL_CONFIG, "scenes": [5]}
    (demonstration,) = demonstrations = record(None, tmp_path / "out", **options)
    assert demonstration.metadata["outcome"] == "success"
    assert demonstration.metadata["status"] == EpisodeStatus.SUCCESS
    assert demonstration.metadata["release_step"] > 0
    assert demonstration.rewards.tolist() == [0.0] * (len(demonstration) - 1) + [1.0]
    assert demonstration.terminations.tolist() == [False] * (len(demonstration) - 1) + [True]
    assert not demonstration.truncations.any()
    assert_replays(demonstration, demonstrations, OFFICIAL_CONFIG)
