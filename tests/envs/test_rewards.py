import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl.config import OFFICIAL, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.envs.rewards import (
    SHAPED,
    SPARSE,
    GiverWeights,
    ReceiverWeights,
    RewardConfig,
    Rewards,
    Situation,
    potentials,
    reward_config,
)
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.protocol.status import EpisodeStatus

RUNNING, SUCCESS = EpisodeStatus.RUNNING, EpisodeStatus.SUCCESS
GOAL = OFFICIAL.protocol.goal_center
points = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
situations = st.builds(
    Situation,
    time=st.just(0.0),
    gripper=points,
    fingertips=points,
    item=points,
    grasped=st.booleans(),
    deviation=st.tuples(*[st.floats(-0.3, 0.3)] * 6),
    held_out=st.booleans(),
)


def situation(time: float = 0.0, **changes: object) -> Situation:
    start = Situation(time, (0.0, 0.0, 1.0), (0.1, 0.0, 1.0), (0.3, 0.0, 1.0), False, (0.0,) * 6, False)
    return dataclasses.replace(start, **changes)  # type: ignore[arg-type]


def test_sparse_is_the_task_alone() -> None:
    rewards = Rewards(SPARSE, GOAL, situation())
    later = situation(0.1, gripper=(0.2, 0.0, 1.0), grasped=True, deviation=(0.1,) * 6, held_out=True)
    for status in (RUNNING, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT):
        assert not any(rewards.receiver(later, status).values())
        assert not any(rewards.giver(later, status).values())
    assert sum(rewards.receiver(later, SUCCESS).values()) == sum(rewards.giver(later, SUCCESS).values()) == 1.0


@given(st.lists(situations, min_size=2, max_size=8), st.sampled_from([SUCCESS, EpisodeStatus.HUMAN_CONTACT]))
def test_guidance_adds_up_to_the_same_whatever_is_done(way: list[Situation], end: EpisodeStatus) -> None:
    """The discounted sum depends on the first situation only, so that no policy gains by it."""
    rewards = Rewards(SHAPED, GOAL, way[0])
    total = 0.0
    for number, now in enumerate(way[1:]):
        last = number == len(way) - 2
        terms = rewards.receiver(now, end if last else RUNNING)
        rewards.go_on(now)
        total += SHAPED.gamma**number * sum(terms[name] for name in ("distance", "grasp", "goal"))
    weights = SHAPED.receiver
    expected = -sum(getattr(weights, name) * value for name, value in potentials(way[0], GOAL).items())
    assert total == pytest.approx(expected, abs=1e-9)


def test_a_cut_off_episode_keeps_its_potential() -> None:
    rewards = Rewards(SHAPED, GOAL, situation())
    near = situation(0.1, fingertips=(0.29, 0.0, 1.0))
    assert rewards.receiver(near, EpisodeStatus.TIMEOUT) == rewards.receiver(near, RUNNING)


def test_coming_nearer_grasping_and_carrying_are_encouraged() -> None:
    rewards = Rewards(SHAPED, GOAL, situation())
    assert rewards.receiver(situation(fingertips=(0.2, 0.0, 1.0)), RUNNING)["distance"] > 0
    grasped = rewards.receiver(situation(grasped=True), RUNNING)
    assert grasped["grasp"] > 0
    assert grasped["goal"] > 0


def test_the_goal_is_where_the_rules_have_it() -> None:
    here, elsewhere = (0.1, 0.2, 1.3), (0.1, 0.2, 0.3)
    there = situation(gripper=here, grasped=True)
    near, far = (Rewards(SHAPED, goal, situation()).receiver(there, RUNNING)["goal"] for goal in (here, elsewhere))
    assert near == pytest.approx(SHAPED.receiver.goal * SHAPED.gamma)
    assert near - far == pytest.approx(SHAPED.receiver.goal * SHAPED.gamma * 1.0)
    config = WorldConfig(protocol=ProtocolConfig(goal_center=here))
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast", rewards="shaped", config=config)
    env.reset(seed=0)
    assert env._rewards is not None
    assert env._rewards._goal == here


def test_the_givers_costs() -> None:
    rewards = Rewards(SHAPED, GOAL, situation(held_out=True))
    terms = rewards.giver(situation(0.1, deviation=(0.05, 0, 0, 0.3, 0, 0)), RUNNING)
    weights = SHAPED.giver
    assert terms["effort"] == pytest.approx(weights.effort * 0.05**2 / 0.1)
    assert terms["discomfort"] == pytest.approx(weights.discomfort * 0.15 * 0.1)
    assert terms["waiting"] == pytest.approx(weights.waiting * 0.1)


def test_names() -> None:
    assert reward_config("shaped") is SHAPED
    assert reward_config(SPARSE) is SPARSE
    with pytest.raises(UnknownNameError, match="rewards 'dense'; valid: sparse, shaped"):
        reward_config("dense")
    with pytest.raises(OptionError, match="rewards=3"):
        reward_config(3)  # type: ignore[arg-type]


def test_the_environment_adds_up_the_terms_it_tells() -> None:
    env = handover_marl.parallel_env(split="test", dataset="synthetic", physics="fast", rewards="shaped")
    env.reset(seed=0, options={"scene_id": 209})
    robot = np.array(PandaConfig().start_joints, dtype=np.float32)
    total = {"giver": 0.0, "receiver": 0.0}
    for number in range(30):
        robot[0] = 0.02 * number
        giver = np.array([0, 0.01 * number, 0, 0, 0, 0, 0, 0], dtype=np.float32)
        _, rewards, _, _, infos = env.step({"giver": giver, "receiver": robot})
        for agent, reward in rewards.items():
            terms = {key: value for key, value in infos[agent].items() if key.startswith("reward/")}
            assert reward == pytest.approx(sum(terms.values()))
            total[agent] += reward
        names = ("task", "distance", "grasp", "goal", "contact", "drop")
        assert {key for key in infos["receiver"] if key.startswith("reward/")} == {f"reward/{name}" for name in names}
    assert total["giver"] < 0
    assert total["receiver"] != 0


@given(situations, st.sampled_from(list(EpisodeStatus)))
def test_outcomes_alone_need_no_situation(now: Situation, status: EpisodeStatus) -> None:
    outcomes = RewardConfig(ReceiverWeights(task=2.0, drop=-1.0), GiverWeights(contact=-3.0))
    rewards = Rewards(outcomes, GOAL, situation())
    assert rewards.only_outcomes
    assert rewards.outcome(status) == (rewards.receiver(now, status), rewards.giver(now, status))
    for shaped in (RewardConfig(ReceiverWeights(grasp=0.1)), RewardConfig(giver=GiverWeights(waiting=-0.1))):
        assert not Rewards(shaped, GOAL, situation()).only_outcomes
