import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.envs.rewards import (
    SHAPED,
    SPARSE,
    GiverWeights,
    ReceiverWeights,
    RewardConfig,
    RewardFunction,
    RewardState,
    compute_potentials,
    make_reward_config,
)
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResetNeededError, UnknownNameError

RUNNING, SUCCESS = EpisodeStatus.RUNNING, EpisodeStatus.SUCCESS
GOAL = OFFICIAL_CONFIG.protocol.goal_center
points = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
situations = st.builds(
    RewardState,
    time=st.just(0.0),
    gripper=points,
    fingertip_center=points,
    object_position=points,
    grasped=st.booleans(),
    deviation=st.tuples(*[st.floats(-0.3, 0.3)] * 6),
    object_offered=st.booleans(),
)


def situation(time: float = 0.0, **changes: object) -> RewardState:
    start = RewardState(time, (0.0, 0.0, 1.0), (0.1, 0.0, 1.0), (0.3, 0.0, 1.0), False, (0.0,) * 6, False)
    return dataclasses.replace(start, **changes)  # type: ignore[arg-type]


def make_rewards(config: RewardConfig, start: RewardState, goal: tuple[float, ...] = GOAL) -> RewardFunction:
    rewards = RewardFunction(config, goal)
    rewards.reset(start)
    return rewards


def terms(config: RewardConfig, before: RewardState, now: RewardState, status: EpisodeStatus) -> dict[str, Any]:
    return make_rewards(config, before).compute_terms(status, lambda: now)


def test_sparse_is_the_task_alone() -> None:
    later = situation(0.1, gripper=(0.2, 0.0, 1.0), grasped=True, deviation=(0.1,) * 6, object_offered=True)
    for status in (RUNNING, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT):
        for values in terms(SPARSE, situation(), later, status).values():
            assert not any(values.values())
    success = terms(SPARSE, situation(), later, SUCCESS)
    assert sum(success["receiver"].values()) == sum(success["giver"].values()) == 1.0


@given(st.lists(situations, min_size=2, max_size=8), st.sampled_from([SUCCESS, EpisodeStatus.HUMAN_CONTACT]))
def test_discounted_guidance_depends_only_on_the_first_state(path: list[RewardState], end: EpisodeStatus) -> None:
    rewards = make_rewards(SHAPED, path[0])
    total = 0.0
    for number, now in enumerate(path[1:]):
        last = number == len(path) - 2
        values = rewards.compute_terms(end if last else RUNNING, lambda now=now: now)["receiver"]  # type: ignore[misc]
        total += SHAPED.gamma**number * sum(values[name] for name in ("distance", "grasp", "goal"))
    weights = SHAPED.receiver
    expected = -sum(getattr(weights, name) * value for name, value in compute_potentials(path[0], GOAL).items())
    assert total == pytest.approx(expected, abs=1e-9)


def test_a_truncated_episode_keeps_its_potential() -> None:
    near = situation(0.1, fingertip_center=(0.29, 0.0, 1.0))
    assert terms(SHAPED, situation(), near, EpisodeStatus.TIMEOUT) == terms(SHAPED, situation(), near, RUNNING)


def test_approaching_grasping_and_carrying_are_rewarded() -> None:
    near = situation(fingertip_center=(0.2, 0.0, 1.0))
    assert terms(SHAPED, situation(), near, RUNNING)["receiver"]["distance"] > 0
    grasped = terms(SHAPED, situation(), situation(grasped=True), RUNNING)["receiver"]
    assert grasped["grasp"] > 0
    assert grasped["goal"] > 0


def test_the_goal_is_that_of_the_protocol() -> None:
    here, elsewhere = (0.1, 0.2, 1.3), (0.1, 0.2, 0.3)
    there = situation(gripper=here, grasped=True)
    near, far = (
        make_rewards(SHAPED, situation(), goal).compute_terms(RUNNING, lambda: there)["receiver"]["goal"]
        for goal in (here, elsewhere)
    )
    assert near == pytest.approx(SHAPED.receiver.goal * SHAPED.gamma)
    assert near - far == pytest.approx(SHAPED.receiver.goal * SHAPED.gamma * 1.0)
    config = WorldConfig(protocol=ProtocolConfig(goal_center=here))
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast", rewards="shaped", world_config=config)
    assert env._rewards._function._goal == here


def test_costs_of_the_giver() -> None:
    later = situation(0.1, deviation=(0.05, 0, 0, 0.3, 0, 0))
    values = terms(SHAPED, situation(object_offered=True), later, RUNNING)["giver"]
    weights = SHAPED.giver
    assert values["effort"] == pytest.approx(weights.effort * 0.05**2 / 0.1)
    assert values["discomfort"] == pytest.approx(weights.discomfort * 0.15 * 0.1)
    assert values["waiting"] == pytest.approx(weights.waiting * 0.1)


def test_no_terms_before_a_reset() -> None:
    with pytest.raises(ResetNeededError, match="reset"):
        RewardFunction(SPARSE, GOAL).compute_terms(RUNNING, situation)


def test_names() -> None:
    assert make_reward_config("shaped") is SHAPED
    assert make_reward_config(SPARSE) is SPARSE
    with pytest.raises(UnknownNameError, match="rewards 'dense'; valid: sparse, shaped"):
        make_reward_config("dense")
    with pytest.raises(OptionError, match=r"rewards must be .*3"):
        make_reward_config(3)  # type: ignore[arg-type]


def test_the_environment_adds_up_the_terms_it_reports() -> None:
    env = handover_marl.parallel_env(split="test", dataset="synthetic", physics="fast", rewards="shaped")
    env.reset(seed=0, options={"scene_id": 209})
    robot = np.array(PandaConfig().start_joints, dtype=np.float32)
    total = {"giver": 0.0, "receiver": 0.0}
    for number in range(30):
        robot[0] = 0.02 * number
        giver = np.array([0, 0.01 * number, 0, 0, 0, 0, 0, 0], dtype=np.float32)
        _, rewards, _, _, infos = env.step({"giver": giver, "receiver": robot})
        for agent, reward in rewards.items():
            parts = {key: value for key, value in infos[agent].items() if key.startswith("reward/")}
            assert reward == pytest.approx(sum(parts.values()))
            total[agent] += reward
        names = ("task", "distance", "grasp", "goal", "contact", "drop")
        assert {key for key in infos["receiver"] if key.startswith("reward/")} == {f"reward/{name}" for name in names}
    assert total["giver"] < 0
    assert total["receiver"] != 0


@given(situations, st.sampled_from(list(EpisodeStatus)))
def test_outcome_terms_need_no_state(now: RewardState, status: EpisodeStatus) -> None:
    outcomes = RewardConfig(ReceiverWeights(task=2.0, drop=-1.0), GiverWeights(contact=-3.0))
    values = make_rewards(outcomes, situation()).compute_terms(status, lambda: pytest.fail("state was read"))
    tiny = RewardConfig(ReceiverWeights(task=2.0, drop=-1.0, grasp=1e-300), GiverWeights(contact=-3.0))
    full = terms(tiny, situation(), now, status)
    for agent in ("receiver", "giver"):
        assert values[agent] == pytest.approx(full[agent], abs=1e-290)
