"""Tests of `flatten`, vectors instead of dictionaries."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import handover_marl
from handover_marl.envs.wrappers.wrapper import FlattenedEnv
from handover_marl.errors import OptionError

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val", "max_cycles": 6}
AGENTS = ("giver", "receiver")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def flattened(**options: Any) -> FlattenedEnv:
    return handover_marl.flatten(handover_marl.parallel_env(**SYNTHETIC, **options))


def test_vectors_hold_all_that_dictionaries_show() -> None:
    pytest.importorskip("embreex", reason="needs the extra `vision`")
    world, env = handover_marl.parallel_env(**SYNTHETIC, obs_mode="state+rgbd"), flattened(obs_mode="state+rgbd")
    shown, seen = world.reset(seed=1)[0], env.reset(seed=1)[0]
    assert shown["receiver"]["wrist_rgb"].any()
    for agent in AGENTS:
        assert env.observation_space(agent).contains(seen[agent])
        back: Any = spaces.unflatten(world.observation_space(agent), seen[agent])
        for key, value in shown[agent].items():
            np.testing.assert_array_equal(back[key], value)


def test_wrappers_that_cannot_follow_say_so() -> None:
    with pytest.raises(OptionError, match="encode once, before flattening"):
        handover_marl.encode(flattened())
    with pytest.raises(OptionError, match="must not be encoded"):
        handover_marl.freeze(flattened())


def test_supersuit_makes_the_spaces_of_all_agents_equal() -> None:
    supersuit = pytest.importorskip("supersuit", reason="needs the extra `supersuit`")
    env = handover_marl.encode(handover_marl.parallel_env(**SYNTHETIC))
    env = supersuit.agent_indicator_v0(supersuit.pad_observations_v0(supersuit.pad_action_space_v0(env)))
    assert env.observation_space("giver") == env.observation_space("receiver")
    assert env.action_space("giver") == env.action_space("receiver")
    envs = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 2, base_class="gymnasium")
    seen, _ = envs.reset(seed=0)
    for _ in range(8):  # more steps than an episode has
        seen, rewards, ended, timed_out, _ = envs.step(np.zeros((4, 8), np.float32))
    assert seen.shape == (4, *env.observation_space("giver").shape)
    assert rewards.shape == ended.shape == timed_out.shape == (4,)
    envs.close()
