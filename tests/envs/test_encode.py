"""Tests of encoded and flattened environments; other libraries' checks of them are in `test_conformance.py`."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from handover_marl import flatten
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.wrappers.encode import EncodedEnv, encode
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.errors import ActionError, OptionError, ResetNeededError, UnknownNameError

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def encoded(agent: str, partner: str, actions: str | None = None, **options: Any) -> EncodedEnv:
    return encode(freeze(parallel_env(**SYNTHETIC, **options), agent, partner), schemes=actions)


@pytest.mark.slow
def test_rewards_add_up_until_the_next_decision() -> None:
    """The reward of a step that lasts until the end of the episode is the sum over its control periods."""
    options = {"max_cycles": 40, "rewards": "shaped"}
    env, world = (
        encoded("giver", "hold", "offer", **options),
        freeze(parallel_env(**SYNTHETIC, **options), "giver", "hold"),
    )
    _, infos = env.reset(seed=0, options={"scene_id": 9})
    before = infos["giver"]["steps"]
    assert 1000 <= before <= 2500
    _, rewards, ended, timed_out, infos = env.step({"giver": np.zeros(7, np.float32)})
    assert (ended["giver"], timed_out["giver"], infos["giver"]["steps"]) == (False, True, 4000)
    terms = [value for key, value in infos["giver"].items() if key.startswith("reward/")]
    assert rewards["giver"] == pytest.approx(sum(terms))
    world.reset(seed=0, options={"scene_id": 9})
    total = 0.0
    while world.agents:
        _, one, _, _, infos = world.step({"giver": np.zeros(8, np.float32)})
        total += one["giver"] if infos["giver"]["steps"] > before else 0.0
    assert rewards["giver"] == pytest.approx(total)
    assert total < -0.01
    env.close()
    world.close()


@pytest.mark.parametrize(
    ("wrap", "error", "message"),
    [
        (lambda world, view: encode(view, "giver"), UnknownNameError, "features of the receiver 'giver'"),
        (lambda world, view: encode(view, {"giver": "giver"}), OptionError, "for receiver, got a choice for 'giver'"),
        (lambda world, view: encode(world, "receiver"), OptionError, "by agent for 2 agents"),
        (lambda world, view: encode(world, api="gymnasium"), OptionError, "one agent, got giver and receiver"),
        (lambda world, view: freeze(encode(world), "receiver"), OptionError, "must not be encoded"),
        (lambda world, view: freeze(flatten(world)), OptionError, "must not be encoded"),
        (lambda world, view: encode(flatten(world)), OptionError, "encode once, before flattening"),
        (lambda world, view: encode(view).step({"receiver": np.zeros(7)}), ResetNeededError, "call reset"),
    ],
)
def test_wrong_use(wrap: Callable[[Any, Any], Any], error: type[Exception], message: str) -> None:
    world = parallel_env(**SYNTHETIC)
    with pytest.raises(error, match=message):
        wrap(world, freeze(world, "receiver", "replay"))


@pytest.mark.parametrize("actions", [None, {}, {"receiver": np.zeros(6)}, {"receiver": np.full(7, np.nan)}])
def test_malformed_outputs_leave_the_world_alone(actions: Any) -> None:
    env = encoded("receiver", "replay")
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ActionError, match="outputs of the receiver must be 7 numbers"):
        env.step(actions)
    np.testing.assert_array_equal(before, env.state())
    assert env.step({"receiver": np.zeros(7)})[4]["receiver"]["steps"] == 100


def test_vectors_hold_all_that_dictionaries_show() -> None:
    pytest.importorskip("embreex", reason="needs the extra `vision`")
    world, plain = (parallel_env(**SYNTHETIC, obs_mode="state+rgbd") for _ in range(2))
    env = flatten(plain)
    shown, seen = world.reset(seed=1)[0], env.reset(seed=1)[0]
    assert shown["receiver"]["wrist_rgb"].any()
    for agent, values in shown.items():
        assert env.observation_space(agent).contains(seen[agent])
        back: Any = spaces.unflatten(world.observation_space(agent), seen[agent])
        for key, value in values.items():
            np.testing.assert_array_equal(back[key], value)


def test_supersuit_makes_the_spaces_of_all_agents_equal() -> None:
    supersuit = pytest.importorskip("supersuit", reason="needs the extra `supersuit`")
    env = encode(parallel_env(**SYNTHETIC, max_cycles=6))
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
