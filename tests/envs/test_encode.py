"""Learning environments keep the promises of Gymnasium, PettingZoo and Stable-Baselines3."""

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

from handover_marl import givers
from handover_marl.envs.encode import LearningEnv, LearningParallelEnv
from handover_marl.errors import OptionError, ResetNeededError, SceneError, UnknownNameError

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.mark.parametrize(
    ("agent", "partner", "actions"),
    [
        ("receiver", "cooperative", "cartesian_delta"),
        ("receiver", "replay", "joint_delta"),
        ("giver", "hold", "deviation"),
        ("giver", "hold", "offer"),
    ],
)
def test_gymnasium_and_stable_baselines_accept_it(agent: str, partner: str, actions: str) -> None:
    env = LearningEnv(agent, partner, actions, time_limit=3.0, **SYNTHETIC)
    if actions != "offer":  # it takes one decision an episode, which Gymnasium's checker will not have
        check_env(env, skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra `train`")
    sb3.check_env(env, warn=False)
    env.close()


def rollout(seed: int) -> list[np.ndarray]:
    env = LearningEnv("receiver", "noisy", control_period=0.2, time_limit=4.0, **SYNTHETIC)
    rng = np.random.default_rng(0)
    seen, _ = env.reset(seed=seed)
    way, over = [seen], False
    while not over:
        seen, reward, ended, timed_out, _ = env.step(rng.uniform(-1, 1, 7).astype(np.float32))
        way.append(np.append(seen, reward))
        over = ended or timed_out
    env.close()
    return way


def test_rollouts_repeat_from_their_seed() -> None:
    for one, other in zip(rollout(3), rollout(3), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(rollout(3)[1], rollout(4)[1])


def test_an_offer_is_one_decision() -> None:
    env = LearningEnv("giver", "hold", "offer", time_limit=4.0, **SYNTHETIC)
    _, info = env.reset(seed=0)
    assert 1000 <= info["steps"] <= 2500
    _, _, ended, timed_out, info = env.step(np.zeros(7, np.float32))
    assert (ended, timed_out, info["steps"]) == (False, True, 4000)
    env.close()


def test_imitation_knows_what_a_giver_would_have_decided() -> None:
    env = LearningEnv("giver", "hold", "offer", **SYNTHETIC)
    env.reset(seed=0)
    teacher = givers.make("cooperative")
    teacher.reset()
    wanted = env.outputs_of(teacher.act(env.observed))
    assert wanted.shape == (7,)
    assert np.abs(wanted).max() > 0.1
    receiver = LearningEnv("receiver", "replay", **SYNTHETIC)
    receiver.reset(seed=0)
    with pytest.raises(OptionError, match="cannot imitate"):
        receiver.outputs_of(np.zeros(9, np.float32))


def test_scenes_can_be_kept_for_testing() -> None:
    env = LearningEnv("receiver", "replay", scenes=[9, 14], **SYNTHETIC)
    assert {env.reset(seed=seed)[1]["scene_id"] for seed in range(6)} == {9, 14}
    with pytest.raises(SceneError, match="are not in s0 val"):
        LearningEnv("receiver", "replay", scenes=[9, 10], **SYNTHETIC)


def test_bad_names_and_order() -> None:
    with pytest.raises(UnknownNameError, match="agent 'robot'"):
        LearningEnv("robot", **SYNTHETIC)
    with pytest.raises(UnknownNameError, match="features of the receiver 'giver'"):
        LearningEnv("receiver", "replay", observe="giver", **SYNTHETIC)
    with pytest.raises(ResetNeededError):
        LearningEnv("receiver", "replay", **SYNTHETIC).step(np.zeros(7, np.float32))


def test_both_agents() -> None:
    env = LearningParallelEnv(observe={"receiver": "grasp"}, time_limit=1.5, **SYNTHETIC)
    parallel_api_test(env, num_cycles=20)
    parallel_seed_test(lambda: LearningParallelEnv(time_limit=1.5, **SYNTHETIC), num_cycles=5)
    env.reset(seed=0)
    zeros = {agent: np.zeros(env.action_space(agent).shape, np.float32) for agent in env.possible_agents}
    steps = 0
    while env.agents:
        *_, ended, timed_out, _ = env.step(zeros)
        steps += 1
    assert steps == 15
    assert all(timed_out.values())
    assert not any(ended.values())
    with pytest.raises(ResetNeededError):
        env.step(zeros)
