from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.envs import handover_env
from handover_marl.envs.rewards import (
    SHAPED,
    SPARSE,
    GiverWeights,
    PresetRewards,
    ReceiverWeights,
    RewardConfig,
    make_reward_config,
)
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.geometry.arrays import NUMPY_ARRAYS

RUNNING, SUCCESS = EpisodeStatus.RUNNING, EpisodeStatus.SUCCESS
GOAL = OFFICIAL_CONFIG.protocol.goal_center
ROW = np.array([0])
State = dict[str, np.ndarray]
points = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def situation(
    time: float = 0.0,
    gripper: tuple[float, ...] = (0.0, 0.0, 1.0),
    object_position: tuple[float, ...] = (0.3, 0.0, 1.0),
    grasped: bool = False,
    deviation: tuple[float, ...] = (0.0,) * 6,
    offered: bool = False,
) -> State:
    """Return the state of one episode that the rewards depend on."""
    return {
        "time": np.array([[time]]),
        "gripper_pose": np.array([[*gripper, 0.0, 0.0, 0.0, 1.0]]),
        "object_poses": np.array([[[*object_position, 0.0, 0.0, 0.0, 1.0]]]),
        "deviation": np.array([[0.0, *deviation]]),
        "holding": np.array([[float(offered)]]),
        "released": np.array([[0.0]]),
        "grasped": np.array([grasped]),
    }


situations = st.builds(
    situation,
    gripper=points,
    object_position=points,
    grasped=st.booleans(),
    deviation=st.tuples(*[st.floats(-0.3, 0.3)] * 6),
    offered=st.booleans(),
)


class Rewards:
    """Preset rewards of one episode, as numbers."""

    def __init__(self, config: RewardConfig, start: State, goal: tuple[float, ...] = GOAL) -> None:
        self._rewards = PresetRewards(config, goal, 1, NUMPY_ARRAYS)
        self._rewards.start(ROW, start)

    def compute(self, now: State, status: EpisodeStatus = RUNNING) -> dict[str, Any]:
        found = self._rewards.compute_terms(ROW, np.array([int(status)]), now)
        return {agent: {name: float(value[0]) for name, value in own.items()} for agent, own in found.items()}


def terms(config: RewardConfig, before: State, now: State, status: EpisodeStatus) -> dict[str, Any]:
    return Rewards(config, before).compute(now, status)


def test_sparse_is_the_task_alone() -> None:
    later = situation(0.1, gripper=(0.2, 0.0, 1.0), grasped=True, deviation=(0.1,) * 6, offered=True)
    for status in (RUNNING, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT):
        for values in terms(SPARSE, situation(), later, status).values():
            assert not any(values.values())
    success = terms(SPARSE, situation(), later, SUCCESS)
    assert sum(success["receiver"].values()) == sum(success["giver"].values()) == 1.0


@given(st.lists(situations, min_size=2, max_size=8), st.sampled_from([SUCCESS, EpisodeStatus.HUMAN_CONTACT]))
def test_discounted_shaping_depends_only_on_the_first_state(path: list[State], end: EpisodeStatus) -> None:
    rewards = Rewards(SHAPED, path[0])
    total = 0.0
    for number, now in enumerate(path[1:]):
        last = number == len(path) - 2
        values = rewards.compute(now, end if last else RUNNING)["receiver"]
        total += SHAPED.gamma**number * sum(values[name] for name in ("distance", "grasp", "goal"))
    # All potentials are 0 once the episode has ended.
    at_once = Rewards(SHAPED, path[0]).compute(path[0], end)["receiver"]
    assert total == pytest.approx(sum(at_once[name] for name in ("distance", "grasp", "goal")), abs=1e-9)
    weights, grasped = SHAPED.receiver, bool(path[0]["grasped"][0])
    if grasped:
        expected = weights.distance + weights.grasp
        expected += weights.goal * (1.0 - np.linalg.norm(path[0]["gripper_pose"][0, :3] - GOAL))
        assert total == pytest.approx(-expected, abs=1e-9)


def test_a_truncated_episode_keeps_its_potential() -> None:
    near = situation(0.1, gripper=(0.29, 0.0, 1.0))
    assert terms(SHAPED, situation(), near, EpisodeStatus.TIMEOUT) == terms(SHAPED, situation(), near, RUNNING)


def test_approaching_grasping_and_carrying_are_rewarded() -> None:
    near = situation(gripper=(0.2, 0.0, 1.0))
    assert terms(SHAPED, situation(), near, RUNNING)["receiver"]["distance"] > 0
    grasped = terms(SHAPED, situation(), situation(grasped=True), RUNNING)["receiver"]
    assert grasped["grasp"] > 0
    assert grasped["goal"] > 0


def test_the_goal_is_that_of_the_protocol() -> None:
    here, elsewhere = (0.1, 0.2, 1.3), (0.1, 0.2, 0.3)
    there = situation(gripper=here, grasped=True)
    near, far = (Rewards(SHAPED, situation(), goal).compute(there)["receiver"]["goal"] for goal in (here, elsewhere))
    assert near == pytest.approx(SHAPED.receiver.goal * SHAPED.gamma)
    assert near - far == pytest.approx(SHAPED.receiver.goal * SHAPED.gamma * 1.0)


def test_the_goal_of_an_environment_is_that_of_its_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    goals = []
    monkeypatch.setattr(handover_env, "make_reward_source", lambda rewards, goal: goals.append(goal))
    config = WorldConfig(protocol=ProtocolConfig(goal_center=(0.1, 0.2, 1.3)))
    handover_marl.parallel_env(dataset="synthetic", physics="fast", rewards="shaped", world_config=config)
    assert goals == [(0.1, 0.2, 1.3)]


def test_costs_of_the_giver() -> None:
    later = situation(0.1, deviation=(0.05, 0, 0, 0.3, 0, 0))
    values = terms(SHAPED, situation(offered=True), later, RUNNING)["giver"]
    weights = SHAPED.giver
    assert values["effort"] == pytest.approx(weights.effort * 0.05**2 / 0.1)
    assert values["discomfort"] == pytest.approx(weights.discomfort * 0.15 * 0.1)
    assert values["waiting"] == pytest.approx(weights.waiting * 0.1)


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
def test_outcome_terms_need_no_state(now: State, status: EpisodeStatus) -> None:
    outcomes = RewardConfig(ReceiverWeights(task=2.0, drop=-1.0), GiverWeights(contact=-3.0))
    values = Rewards(outcomes, {}).compute({}, status)
    tiny = RewardConfig(ReceiverWeights(task=2.0, drop=-1.0, grasp=1e-300), GiverWeights(contact=-3.0))
    full = terms(tiny, situation(), now, status)
    for agent in ("receiver", "giver"):
        assert values[agent] == pytest.approx(full[agent], abs=1e-290)
