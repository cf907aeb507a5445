"""Tests of the episode loop: when policies act, their observations, seeds, hold times and errors."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import (
    MEASURED,
    ActionRecorder,
    EpisodeCallback,
    PolicyDecision,
    call_policy,
    derive_giver_seed,
    derive_receiver_seed,
    run_episode,
    start_policy,
    steps_from_hold_time,
)
from handover_marl.errors import OptionError, PolicyError, SimulationError
from handover_marl.givers.reactions import CooperativeGiver
from handover_marl.policies.batch import SequentialPolicyBatch
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


@pytest.fixture
def episode() -> Iterator[Episode]:
    episode = Episode("fast")
    episode.reset(SyntheticDataset().load_scene(SCENE))
    yield episode
    episode.close()


def test_both_are_asked_when_they_want_to_be(pair: tuple[Counting, Counting], episode: Episode) -> None:
    (receiver, giver), decisions = pair, Decisions()
    run_episode(episode, receiver, giver, until=200, callbacks=[decisions])
    assert (episode.steps, int(episode.status)) == (200, 0)
    assert receiver.times == list(range(0, 200, 70))
    assert giver.times == list(range(0, 200, 30))
    assert decisions.steps == sorted({*receiver.times, *giver.times})


@pytest.mark.parametrize(
    ("inference_time", "calls", "effective", "late"),
    [
        (0.0, [0, 70, 140, 210], [0, 70, 140, 210], 0),
        (0.03, [0, 70, 140, 210], [30, 100, 170, 240], 120),
        # The next call begins when the last one has returned.
        (0.1, [0, 100, 200], [100, 200], 250),
    ],
)
def test_actions_take_effect_after_the_inference_time(
    pair: tuple[Counting, Counting], inference_time: float, calls: list[int], effective: list[int], late: int
) -> None:
    """Until the first action takes effect, the robot holds its joint positions; the giver does not wait."""
    receiver, giver = pair
    start, actions = receiver.action, ActionRecorder()
    receiver.action = start + np.float32(0.01)
    episode, decisions = Episode("fast"), Decisions()
    episode.reset(SyntheticDataset().load_scene(SCENE))
    found = run_episode(
        episode, receiver, giver, until=250, callbacks=[decisions, actions], inference_time=inference_time
    )
    assert (receiver.times, giver.times, found) == (calls, list(range(0, 250, 30)), late)
    assert set(effective) <= set(decisions.steps)
    np.testing.assert_array_equal(actions.actions[: effective[0]], start[None].repeat(effective[0], axis=0))
    np.testing.assert_array_equal(actions.actions[effective[0] :], receiver.action[None].repeat(250 - effective[0], 0))
    assert np.flatnonzero(actions.times).tolist() == calls
    episode.close()


def test_measured_inference_takes_simulated_time(pair: tuple[Counting, Counting], episode: Episode) -> None:
    receiver, _ = pair
    act = receiver.act
    receiver.act = lambda observation: [time.sleep(0.08), act(observation)][1]  # type: ignore[method-assign]
    late = run_episode(episode, receiver, until=200, inference_time=MEASURED)
    assert late == 200
    assert len(receiver.times) in (2, 3)
    assert receiver.times[1] >= 80


def test_playing_stops_on_request(pair: tuple[Counting, Counting], episode: Episode) -> None:
    receiver, giver = pair
    run_episode(episode, receiver, giver, until=lambda: len(receiver.times) == 3)
    assert episode.steps == receiver.times[-1] == 140


def test_every_policy_gets_a_seed_of_its_own(pair: tuple[Counting, Counting], episode: Episode) -> None:
    (receiver, giver), dataset = pair, SyntheticDataset()
    for scene_id, seed in ((209, 0), (209, 1), (214, 0), (209, None), (209, 0)):
        episode.reset(dataset.load_scene(scene_id))
        run_episode(episode, receiver, giver, seed=seed, until=1)
        assert receiver.seeds[-1] == derive_receiver_seed(seed, receiver.first_observation)
        assert giver.seeds[-1] == derive_giver_seed(seed, scene_id)
    assert len({*receiver.seeds[:3], *giver.seeds[:3]}) == 6
    # Without a seed, the seed is 0, so that results can be reproduced.
    assert receiver.seeds[0] == receiver.seeds[3] == receiver.seeds[4]


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


SEEN: dict[str, np.ndarray] = {}


class CountingPolicy:
    """Policy whose action is the number of its calls since the reset, held for `hold_time` (s)."""

    name = "counting"

    def __init__(self, hold_time: Any, error: BaseException | None = None) -> None:
        self.hold_time = hold_time
        self.asked = 0
        self.error = error
        self.prepared: tuple[str, ...] = ()

    def prepare(self, object_names: Sequence[str]) -> None:
        self.prepared += tuple(object_names)

    def reset(self, seed: int | None = None) -> None:
        if self.error is not None:
            raise self.error
        self.asked = 0

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        if self.error is not None:
            raise self.error
        self.asked += 1
        return np.full(9, self.asked, dtype=np.float32)


@pytest.mark.parametrize(
    ("hold_time", "expected"),
    [
        (0.1, [1, 2, 3, 4, 5]),
        (0.25, [1, 1, 1, 2, 2]),
        (0.3, [1, 1, 1, 2, 2]),
        (0.001, [1, 2, 3, 4, 5]),
        (float("inf"), [1] * 5),
    ],
)
def test_policies_are_asked_when_they_want_to_be(hold_time: float, expected: list[int]) -> None:
    batch, row = SequentialPolicyBatch([CountingPolicy(hold_time)], np.asarray), np.array([0])
    for _ in range(2):
        batch.reset(0, None, ())
        found = [batch.act(row, lambda rows: SEEN, np.array([100 * n]))[0] for n in range(5)]
        assert [int(actions[0, 0]) for actions in found] == expected


@pytest.mark.parametrize("hold_time", [0, -0.1, float("nan"), "0.1", None, True])
def test_no_time_at_all_is_refused(hold_time: Any) -> None:
    with pytest.raises(OptionError, match="hold_time"):
        call_policy(CountingPolicy(hold_time), SEEN, 0)


def test_short_times_are_one_step() -> None:
    assert steps_from_hold_time(1e-9) == steps_from_hold_time(0.001) == 1
    assert steps_from_hold_time(np.float32(0.1)) == 100
    assert steps_from_hold_time(1e300) == steps_from_hold_time(np.inf) == steps_from_hold_time(1e9) == 10**12
    assert steps_from_hold_time(np.float32(1e30)) == 10**12
    assert steps_from_hold_time(999_999_999.0) == 10**12 - 1000
    assert steps_from_hold_time(0.0014) == 1
    assert steps_from_hold_time(0.0016) == 2


@pytest.mark.parametrize("error", [ZeroDivisionError("nought"), SystemExit("bye")])
def test_whose_fault_it_was(error: BaseException) -> None:
    policy = CountingPolicy(0.1, error)
    with pytest.raises(PolicyError, match=rf"policy 'counting' \(reset\) failed: {type(error).__name__}: {error}"):
        start_policy(policy, None)
    with pytest.raises(PolicyError, match=r"policy 'counting' \(after 300 steps\) failed"):
        call_policy(policy, SEEN, 300)


def test_errors_of_the_library_and_of_the_user_stay_what_they_are() -> None:
    with pytest.raises(SimulationError, match="broken"):
        start_policy(CountingPolicy(0.1, SimulationError("broken")), None)
    with pytest.raises(KeyboardInterrupt):
        call_policy(CountingPolicy(0.1, KeyboardInterrupt()), SEEN, 0)
