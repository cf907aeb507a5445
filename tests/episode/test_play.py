"""Tests of the episode loop: when policies act, with which observations and with which seeds."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import (
    EpisodeCallback,
    PolicyDecision,
    derive_giver_seed,
    derive_receiver_seed,
    run_episode,
)
from handover_marl.givers.reactions import CooperativeGiver
from handover_marl.policies.policy import Policy
from handover_marl.receivers import make_policy_context
from handover_marl.receivers.yang2021 import Yang2021Receiver

SCENE = 209
#: A step at which both agents have moved for a while.
HALF_WAY = 2500

Observation = dict[str, np.ndarray]


class Decisions(EpisodeCallback):
    """Callback that records the steps and the actions of all decisions."""

    def on_reset(self, episode: Episode) -> None:
        self.steps: list[int] = []
        self.robot: list[np.ndarray] = []
        self.giver: list[np.ndarray] = []

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        self.steps.append(episode.steps)
        self.robot.append(decision.receiver_action.copy())
        self.giver.append(decision.giver_action.copy())


class CopyingReceiver(Yang2021Receiver):
    """Receiver that plans with copies of the observed arrays."""

    def act(self, observation: Observation) -> np.ndarray:
        return np.array(super().act({key: value.copy() for key, value in observation.items()}))


class ScribblingGiver(CooperativeGiver):
    def act(self, observation: Observation) -> np.ndarray:
        action = np.array(super().act({key: value.copy() for key, value in observation.items()}))
        for value in observation.values():
            value[...] = 7.0
        return action


class KeepingGiver(CooperativeGiver):
    """Giver that keeps every observation together with a copy of it."""

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.kept: list[tuple[Observation, Observation]] = []

    def act(self, observation: Observation) -> np.ndarray:
        self.kept.append((observation, {key: value.copy() for key, value in observation.items()}))
        return super().act(observation)


def played(receiver: type[Yang2021Receiver], giver: Any, until: int | None = None) -> tuple[Any, ...]:
    dataset = SyntheticDataset()
    episode, decisions = Episode("fast"), Decisions()
    episode.reset(dataset.load_scene(SCENE))
    run_episode(episode, receiver(make_policy_context(dataset)), giver, seed=0, until=until, callbacks=[decisions])
    end = (episode.status, episode.steps, episode.release_step)
    episode.close()
    return (*end, decisions)


def assert_same(first: tuple[Any, ...], second: tuple[Any, ...]) -> None:
    assert first[:3] == second[:3]
    assert first[3].steps == second[3].steps
    np.testing.assert_array_equal(first[3].robot, second[3].robot)
    np.testing.assert_array_equal(first[3].giver, second[3].giver)


@pytest.mark.slow
def test_what_policies_write_into_their_observations_is_seen_by_nobody() -> None:
    keeping = KeepingGiver()
    clean = played(CopyingReceiver, keeping, HALF_WAY)
    assert np.abs(clean[3].giver).max() > 0.01
    for seen, as_it_was in keeping.kept:
        for key, value in seen.items():
            np.testing.assert_array_equal(value, as_it_was[key])
    assert len(keeping.kept) > 20
    assert_same(played(CopyingReceiver, ScribblingGiver(), HALF_WAY), clean)


class Counting(Policy):
    """Policy with a constant action that records its seeds, its first observation and the times of its calls (ms)."""

    name = "counting"

    def __init__(self, action: np.ndarray, hold_time: float) -> None:
        self.action, self._hold_time = action, hold_time
        self.seeds: list[int | None] = []
        self.times: list[int] = []

    @property
    def hold_time(self) -> float:
        return self._hold_time

    def reset(self, seed: int | None = None) -> None:
        self.seeds.append(seed)
        self.times = []

    def act(self, observation: Observation) -> np.ndarray:
        if not self.times:
            self.first_observation = {key: value.copy() for key, value in observation.items()}
        self.times.append(round(1000 * float(observation["time"][0])))
        return self.action


@pytest.fixture
def pair() -> tuple[Counting, Counting]:
    start = np.array(OFFICIAL_CONFIG.physics.panda.start_joints, dtype=np.float32)
    return Counting(start, 0.07), Counting(np.zeros(8, dtype=np.float32), 0.03)


def test_both_are_asked_when_they_want_to_be(pair: tuple[Counting, Counting]) -> None:
    receiver, giver = pair
    episode, decisions = Episode("fast"), Decisions()
    episode.reset(SyntheticDataset().load_scene(SCENE))
    run_episode(episode, receiver, giver, until=200, callbacks=[decisions])
    assert (episode.steps, int(episode.status)) == (200, 0)
    assert receiver.times == list(range(0, 200, 70))
    assert giver.times == list(range(0, 200, 30))
    assert decisions.steps == sorted({*receiver.times, *giver.times})
    episode.close()


def test_playing_stops_on_request(pair: tuple[Counting, Counting]) -> None:
    receiver, giver = pair
    episode = Episode("fast")
    episode.reset(SyntheticDataset().load_scene(SCENE))
    run_episode(episode, receiver, giver, until=lambda: len(receiver.times) == 3)
    assert episode.steps == receiver.times[-1] == 140
    episode.close()


def test_every_policy_gets_a_seed_of_its_own(pair: tuple[Counting, Counting]) -> None:
    receiver, giver = pair
    episode, dataset = Episode("fast"), SyntheticDataset()
    for scene_id, seed in ((209, 0), (209, 1), (214, 0), (209, None), (209, 0)):
        episode.reset(dataset.load_scene(scene_id))
        run_episode(episode, receiver, giver, seed=seed, until=1)
        assert receiver.seeds[-1] == derive_receiver_seed(seed, receiver.first_observation)
        assert giver.seeds[-1] == derive_giver_seed(seed, scene_id)
    assert len({*receiver.seeds[:3], *giver.seeds[:3]}) == 6
    # Without a seed, the seed is 0, so that results can be reproduced.
    assert receiver.seeds[0] == receiver.seeds[3] == receiver.seeds[4]
    episode.close()


def test_the_seed_of_a_receiver_depends_on_the_run_and_on_every_observed_array() -> None:
    observation = {"time": np.zeros(1), "pose": np.zeros(7)}
    seeds = {derive_receiver_seed(seed, observation) for seed in (0, 1, 2)}
    for key, value in observation.items():
        seeds.add(derive_receiver_seed(0, observation | {key: value + 1.0}))
    assert len(seeds) == 5
    assert derive_receiver_seed(None, dict(reversed(observation.items()))) == derive_receiver_seed(0, observation)


def test_seeds_are_those_of_earlier_versions() -> None:
    """Seeds equal those of earlier versions, so that stored results can be reproduced."""
    assert derive_giver_seed(0, 209) == 989422024
    assert derive_receiver_seed(3, {"time": np.zeros(1, dtype=np.float32)}) == 2691522388


def test_an_episode_ends_at_the_horizon_of_the_rules(pair: tuple[Counting, Counting]) -> None:
    receiver, _ = pair
    rules = replace(OFFICIAL_CONFIG.protocol, horizon_steps=100)
    episode = Episode("fast", replace(OFFICIAL_CONFIG, protocol=rules))
    for until in (None, 500, lambda: False):
        episode.reset(SyntheticDataset().load_scene(SCENE))
        run_episode(episode, receiver, until=until)
        assert (episode.steps, episode.status.label) == (100, "timeout")
        assert receiver.times == [0, 70]
    episode.close()
