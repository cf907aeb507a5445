"""Tests of user-defined rewards: their transitions, checks and reports of their terms, and combinations."""

import dataclasses
import functools
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.config import PandaConfig
from handover_marl.envs.custom_rewards import combine_rewards, resolve_rewards, set_discount
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.rewards import SHAPED, SPARSE, TERMS, RewardWeights
from handover_marl.envs.transition import Transition
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResetNeededError, RewardError, UnknownNameError
from tests.envs.custom_rewards import Counter, approach

START = np.array(PandaConfig().start_joints, dtype=np.float32)
MODULE = "tests.envs.custom_rewards"
Make = Callable[..., HandoverEnv]


@pytest.fixture
def make() -> Iterator[Make]:
    made = []

    def make_env(rewards: Any, **options: Any) -> HandoverEnv:
        made.append(
            handover_marl.parallel_env(
                **{"split": "test", "dataset": "synthetic", "physics": "fast", "rewards": rewards} | options
            )
        )
        return made[-1]

    yield make_env
    for env in made:
        env.close()


def actions(number: int = 0) -> dict[str, Any]:
    robot = START + np.float32(0.02 * number)
    return {"giver": np.array([0, 0.01 * number, 0, 0, 0, 0, 0, 0], dtype=np.float32), "receiver": robot}


def rollout(env: HandoverEnv, steps: int = 5) -> list[Any]:
    results: list[Any] = [env.reset(seed=0, options={"scene_id": 209})]
    return results + [env.step(actions(number)) for number in range(steps)]


def terms_of(infos: dict[str, Any], agent: str) -> dict[str, float]:
    return {key.removeprefix("reward/"): value for key, value in infos[agent].items() if key.startswith("reward/")}


def returning(result: Any) -> Any:
    """Return a reward that gives well-formed terms at the start of an episode and `result` after every step."""

    class Mine:
        def __call__(self, transition: Transition) -> Any:
            return result if transition.next_state["time"][0] > 0 else {"receiver": {"near": 0.0}, "giver": {}}

    return Mine()


def test_a_transition_describes_the_step(make: Make) -> None:
    seen: list[Transition] = []

    def record(transition: Transition) -> dict[str, dict[str, float]]:
        seen.append(transition)
        return {"receiver": {"number": float(len(seen))}}

    env = make(record, max_cycles=3)
    results = rollout(env, 3)
    assert len(seen) == 4, "one call in the first reset, for the names of the terms"
    for number, transition in enumerate(seen[1:]):
        before, after = results[number][0], results[number + 1][0]
        for agent in ("giver", "receiver"):
            assert env.observation_space(agent).contains(transition.next_observations[agent])
            for key, value in after[agent].items():
                np.testing.assert_array_equal(transition.next_observations[agent][key], value)
                np.testing.assert_array_equal(transition.observations[agent][key], before[agent][key])
            np.testing.assert_array_equal(transition.actions[agent], actions(number)[agent])
            public = {key: value for key, value in results[number + 1][4][agent].items() if "reward" not in key}
            assert transition.infos[agent] == public
        assert (transition.step, transition.duration) == (number, 0.1)
        assert transition.status is EpisodeStatus.RUNNING
        assert (transition.terminated, transition.truncated) == (False, number == 2)
        assert transition.state is transition.observations["giver"]
        assert not transition.is_success
    env.reset()
    env.step(actions())
    assert seen[-1].step == 0


def test_transitions_cannot_be_changed(make: Make) -> None:
    """Neither the reward nor an agent that writes into its observation can change a transition."""
    kept: list[Transition] = []
    env = make(lambda transition: kept.append(transition) or {})  # type: ignore[func-returns-value]
    observations, _ = env.reset(seed=0)
    expected = observations["receiver"]["gripper_pose"].copy()
    for arrays in observations.values():
        for value in arrays.values():
            value[:] = 7.0
    env.step(actions())
    transition = kept[-1]
    np.testing.assert_array_equal(transition.state["gripper_pose"], expected)
    for arrays in (*transition.observations.values(), *transition.next_observations.values(), transition.actions):
        for value in arrays.values():
            with pytest.raises(ValueError, match="read-only"):
                value[0] = 1.0


def test_contacts_and_outcome_reach_the_reward(make: Make) -> None:
    seen: list[Transition] = []

    def outcome(transition: Transition) -> dict[str, dict[str, float]]:
        seen.append(transition)
        is_drop = bool(transition.status & EpisodeStatus.OBJECT_DROP)
        return {"receiver": {"drop": -2.0 * is_drop, "time": -transition.duration}, "giver": {"a": 1.0}}

    env = make(outcome, control_period=0.3)
    env.reset(seed=0, options={"scene_id": 209})
    released = np.array([0, 0, 0, 0, 0, 0, 0, 1], dtype=np.float32)
    while env.agents:
        _, rewards, terminations, _, infos = env.step({"giver": released, "receiver": START})
        assert seen[-1].contacts is env._episode.contacts
    assert terminations["receiver"]
    assert seen[-1].terminated
    assert seen[-1].status is env._episode.status is EpisodeStatus.OBJECT_DROP
    assert 0.001 <= seen[-1].duration <= 0.3
    assert sum(transition.duration for transition in seen[1:]) == pytest.approx(infos["giver"]["steps"] / 1000)
    assert rewards == {"giver": 1.0, "receiver": pytest.approx(-2.0 - seen[-1].duration)}
    assert terms_of(infos, "receiver") == {"drop": -2.0, "time": -seen[-1].duration}


def test_keys_are_fixed_from_the_reset_on(make: Make) -> None:
    def sometimes(transition: Transition) -> dict[str, dict[str, float]]:
        near = float(transition.duration > 0)
        return {} if transition.step > 1 else {"receiver": {"near": near}, "giver": {"calm": 0}}

    for rewards, expected in ((approach, {"approach"}), (sometimes, {"near"})):
        env = make(rewards)
        results = rollout(env, 3)
        for result in results:
            assert set(terms_of(result[-1], "receiver")) == expected
        assert set(terms_of(results[0][-1], "receiver").values()) == {0.0}
    assert [result[1]["receiver"] for result in results[1:]] == [1.0, 1.0, 0.0]
    assert terms_of(results[-1][-1], "giver") == {"calm": 0.0}


@pytest.mark.slow
def test_memory_belongs_to_one_environment_and_one_episode(make: Make) -> None:
    for rewards in (Counter(), Counter, f"{MODULE}:Counter"):
        first, second = make(rewards), make(rewards)
        first.reset(seed=0)
        second.reset(seed=0)
        counts = [env.step(actions())[1]["giver"] for env in (first, first, second, first)]
        assert counts == [1.0, 2.0, 1.0, 3.0]
        first.reset()
        assert first.step(actions())[1]["giver"] == 1.0


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (None, "terms of reward '.*Mine' must be a dict for giver and receiver, got None"),
        ({"robot": {"near": 0.0}}, "must be a dict for giver and receiver, got {'robot'"),
        ({"receiver": 1.0}, "must be a dict for giver and receiver, got {'receiver': 1.0}"),
        ({"receiver": ["near"]}, "must be a dict for giver and receiver, got {'receiver'"),
        ({"receiver": {1: 2.0}}, "must be a dict for giver and receiver, got {'receiver': {1"),
        ({"receiver": {"far": 0.0}}, "term 'far' of the receiver in reward '.*Mine' must be one of near"),
        ({"receiver": {"near": np.float32("inf")}}, "term 'near' of the receiver .* must be finite, got .*inf"),
        ({"receiver": {"near": np.zeros(1)}}, "term 'near' of the receiver .* must be a single number, got array"),
    ],
)
def test_wrong_terms_are_named(make: Make, result: Any, message: str) -> None:
    env = make(returning(result))
    env.reset(seed=0, options={"scene_id": 209})
    with pytest.raises(RewardError, match=message):
        env.step(actions())
    with pytest.raises(ResetNeededError):
        env.step(actions())


def test_failures_are_named_in_the_first_reset(make: Make) -> None:
    with pytest.raises(RewardError, match=r"failed: SystemExit: 3 "):
        make(lambda transition: sys.exit(3)).reset(seed=0)
    for wrong in (functools.partial(approach, threading.Lock()), dataclasses.make_dataclass("NeedsScale", ["scale"])):
        with pytest.raises(RewardError, match=r"reward '(partial|NeedsScale)' failed: TypeError"):
            make(wrong)


def test_values_of_rewards(monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve_rewards("sparse") is SPARSE
    assert resolve_rewards(f"{MODULE}:approach") is approach
    with pytest.raises(UnknownNameError, match="unknown rewards 'dense'; valid: sparse, shaped"):
        handover_marl.parallel_env(rewards="dense")
    with pytest.raises(UnknownNameError, match="it cannot be imported"):
        handover_marl.parallel_env(rewards=f"{MODULE}:nothing")
    with pytest.raises(OptionError, match=r"rewards must be one of sparse, shaped, .* got 3"):
        handover_marl.parallel_env(rewards=3)  # type: ignore[arg-type]
    monkeypatch.setattr(approach, "reset", print, raising=False)
    with pytest.raises(OptionError, match="got the function 'approach'; write a class"):
        resolve_rewards(approach)
    for wrong in ((), (("a", "sparse"),), ((float("nan"), "sparse"),), ((True, "sparse"),), (3,)):
        with pytest.raises(OptionError):
            combine_rewards(*wrong)  # type: ignore[arg-type]


def test_discounts_reach_the_shaping_terms() -> None:
    assert set_discount("shaped", 0.5) == dataclasses.replace(SHAPED, gamma=0.5)
    combined = set_discount(f"{MODULE}:SHAPED_AND_OWN", 0.5)
    assert combined.parts == ((1.0, dataclasses.replace(SHAPED, gamma=0.5)), (0.5, approach))
    assert set_discount(approach, 0.5) is approach
    assert set_discount(f"{MODULE}:approach", 0.5) == f"{MODULE}:approach"


@pytest.mark.slow
def test_shaped_rewards_in_a_combination_are_the_shaped_rewards(make: Make) -> None:
    plain = rollout(make("shaped"), 5)
    combined = rollout(make(combine_rewards("shaped", (0.5, approach), RewardWeights(giver={"time": -1.0}))), 5)
    own = rollout(make(approach), 5)
    for one, both, mine in zip(plain, combined, own, strict=True):
        expected = terms_of(one[-1], "receiver") | {"approach": 0.5 * terms_of(mine[-1], "receiver")["approach"]}
        assert terms_of(both[-1], "receiver") == expected
    assert terms_of(combined[-1][-1], "giver") == terms_of(plain[-1][-1], "giver") | {"time": -0.1}
    assert combined[-1][1]["receiver"] == pytest.approx(plain[-1][1]["receiver"] + 0.5 * own[-1][1]["receiver"])
    assert any(result[1]["receiver"] != 0.0 for result in own[1:])


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["fast", "mujoco"])
def test_vector_environments_have_the_rewards_of_single_ones(physics: str, make: Make) -> None:
    options: dict[str, Any] = {"physics": physics, "dataset": "synthetic", "max_cycles": 4}
    weights = RewardWeights(dict.fromkeys(TERMS, 0.5), dict.fromkeys(TERMS, -1.0))
    options["rewards"] = combine_rewards(approach, Counter(), (0.5, weights))
    envs = handover_marl.vector_env(2, None, threads=1, **options)
    envs.reset(seed=5)
    still = {"giver": np.full((2, 8), 0.05, np.float32), "receiver": np.tile(START + np.float32(0.1), (2, 1))}
    alone = make(split="train", **options)
    alone.reset(seed=6)
    for _ in range(4):
        _, found, _, _, infos = envs.step(still)
        _, expected, _, _, expected_infos = alone.step({key: value[1] for key, value in still.items()})
        for agent in ("giver", "receiver"):
            assert found[agent][1] == expected[agent]
            for key, value in terms_of(expected_infos, agent).items():
                assert infos[agent][f"reward/{key}"][1] == value
    envs.close()
