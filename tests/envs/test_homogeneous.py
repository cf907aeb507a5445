"""Tests of `flatten` (vectors instead of dictionaries) and `homogeneous` (equal spaces for all agents)."""

import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils.conversions import parallel_to_aec

import handover_marl
from handover_marl.envs.wrappers.homogeneous import HomogeneousEnv
from handover_marl.envs.wrappers.wrapper import FlattenedEnv, ParallelWrapper
from handover_marl.errors import ActionError, OptionError, ResetNeededError

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val", "max_cycles": 6}
AGENTS = ("giver", "receiver")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def flattened(**options: Any) -> FlattenedEnv:
    return handover_marl.flatten(handover_marl.parallel_env(**SYNTHETIC, **options))


def equal(**options: Any) -> HomogeneousEnv:
    return handover_marl.homogeneous(handover_marl.parallel_env(**SYNTHETIC, **options))


def encoded() -> HomogeneousEnv:
    return handover_marl.homogeneous(handover_marl.encode(handover_marl.parallel_env(**SYNTHETIC)))


def frozen() -> HomogeneousEnv:
    return handover_marl.homogeneous(handover_marl.freeze(handover_marl.parallel_env(**SYNTHETIC)))


MAKERS = [flattened, equal, encoded, frozen]


@pytest.mark.parametrize("make", MAKERS)
def test_pettingzoo_accepts_it(make: Callable[[], ParallelWrapper]) -> None:
    parallel_api_test(make(), num_cycles=10)
    parallel_seed_test(make, num_cycles=5)
    api_test(parallel_to_aec(make()), num_cycles=10)


def rollout(env: Any, seed: int) -> list[dict[str, np.ndarray]]:
    seen = [env.reset(seed=seed)[0]]
    for agent in env.possible_agents:
        env.action_space(agent).seed(seed)
    while env.agents:
        observations, rewards, *_ = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        seen += [observations, {agent: np.array([rewards[agent]]) for agent in rewards}]
    return seen


@pytest.mark.parametrize("make", MAKERS)
def test_whole_rollouts_repeat_from_their_seed(make: Callable[[], ParallelWrapper]) -> None:
    env = make()
    first, again, copied = rollout(env, 3), rollout(env, 3), rollout(pickle.loads(pickle.dumps(env)), 3)
    assert len(first) > 2
    for other in (again, copied):
        for one, two in zip(first, other, strict=True):
            for agent in one:
                np.testing.assert_array_equal(one[agent], two[agent])


def test_vectors_hold_all_that_dictionaries_show() -> None:
    pytest.importorskip("embreex", reason="needs the extra `vision`")
    world, env = handover_marl.parallel_env(**SYNTHETIC, obs_mode="state+rgbd"), flattened(obs_mode="state+rgbd")
    shown, seen = world.reset(seed=1)[0], env.reset(seed=1)[0]
    assert shown["receiver"]["wrist_rgb"].any()
    for agent in AGENTS:
        assert env.observation_space(agent).contains(seen[agent])
        back = env.unflatten(agent, seen[agent])
        assert back.keys() == shown[agent].keys()
        for key, value in shown[agent].items():
            np.testing.assert_array_equal(back[key], value)
            assert back[key].dtype == value.dtype
    with pytest.raises(OptionError, match="vector of the giver must have shape"):
        env.unflatten("giver", seen["receiver"])


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31 - 1), agent=st.sampled_from(AGENTS))
def test_any_observation_comes_back_from_its_vector(seed: int, agent: str) -> None:
    world = handover_marl.parallel_env(**SYNTHETIC)
    space = world.observation_space(agent)
    space.seed(seed)
    observation = space.sample()
    back = handover_marl.flatten(world).unflatten(agent, np.asarray(spaces.flatten(space, observation)))
    for key, value in observation.items():
        np.testing.assert_array_equal(back[key], value)


@pytest.mark.parametrize("make", [equal, encoded])
def test_all_agents_have_the_same_spaces(make: Callable[[], HomogeneousEnv]) -> None:
    env = make()
    assert env.observation_space("giver") == env.observation_space("receiver")
    assert env.action_space("giver") == env.action_space("receiver")
    inner = env.env
    assert env.get_sizes("receiver") == tuple(
        getattr(inner, f"{what}_space")("receiver").shape[0] for what in ("observation", "action")
    )
    seen = env.reset(seed=0)[0]
    n = max(env.get_sizes(agent)[0] for agent in AGENTS)
    for number, agent in enumerate(AGENTS):
        own = env.get_sizes(agent)[0]
        assert env.observation_space(agent).contains(seen[agent])
        np.testing.assert_array_equal(seen[agent][n:], np.eye(2)[number])
        assert not seen[agent][own:n].any()
        assert seen[agent][:own].any()


def test_padded_observations_are_ones_own_with_zeros() -> None:
    plain, env = handover_marl.encode(handover_marl.parallel_env(**SYNTHETIC)), encoded()
    shown, seen = plain.reset(seed=2)[0], env.reset(seed=2)[0]
    for agent in AGENTS:
        np.testing.assert_array_equal(seen[agent][: env.get_sizes(agent)[0]], shown[agent])


@settings(max_examples=50)
@given(seed=st.integers(0, 2**31 - 1), agent=st.sampled_from(AGENTS), raw=st.booleans())
def test_ones_own_action_comes_back_whatever_follows_it(seed: int, agent: str, raw: bool) -> None:
    env = ENVS[raw]
    own = env.env.action_space(agent)
    own.seed(seed)
    wanted = own.sample()
    space = env.action_space(agent)
    filled = np.random.default_rng(seed).uniform(space.low, space.high).astype(np.float32)
    filled[: len(wanted)] = wanted
    np.testing.assert_array_equal(env.unpad_action(agent, filled), wanted)
    assert space.contains(filled)
    # The part of any action of the common space that an agent uses is within the agent's own bounds.
    space.seed(seed)
    assert own.contains(env.unpad_action(agent, space.sample()))


ENVS = {True: equal(), False: encoded()}


def test_what_is_beyond_an_agents_own_changes_nothing() -> None:
    one, other = encoded(), encoded()
    assert one.get_sizes("giver")[1] == 8
    assert one.get_sizes("receiver")[1] == 7
    states = []
    for env, rest in ((one, -1.0), (other, 1.0)):
        env.reset(seed=3)
        for _ in range(3):
            env.step({"giver": np.zeros(8), "receiver": np.array([*[0.5] * 7, rest])})
        states.append(env.state())
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("bad", [None, np.zeros(7), np.full(8, np.nan), "closer", ["0.5"] * 8, np.zeros((1, 8))])
def test_malformed_actions_leave_the_world_alone(bad: Any) -> None:
    env = encoded()
    with pytest.raises(ResetNeededError):
        env.step({})
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ActionError, match="action of the receiver must be 8 numbers, of which 7 are used"):
        env.step({"giver": np.zeros(8), "receiver": bad})
    with pytest.raises(ActionError, match="a dict for giver and receiver"):
        env.step({"giver": np.zeros(8), "receiver": np.zeros(8), "robot": np.zeros(8)})
    np.testing.assert_array_equal(before, env.state())


def test_wrappers_that_cannot_follow_say_so() -> None:
    with pytest.raises(OptionError, match="encode once, before flattening"):
        handover_marl.encode(flattened())
    with pytest.raises(OptionError, match="must not be encoded"):
        handover_marl.freeze(flattened())
    with pytest.raises(OptionError, match="env must be made by"):
        handover_marl.flatten(object())  # type: ignore[arg-type]
    for wrong in (None, gymnasium.make("CartPole-v1"), handover_marl.HandoverEnv):
        with pytest.raises(OptionError, match="env must be made by"):
            handover_marl.homogeneous(wrong)  # type: ignore[arg-type]


def test_supersuit_takes_it_without_padding() -> None:
    supersuit = pytest.importorskip("supersuit", reason="needs the extra `loops`")
    vectors = supersuit.pettingzoo_env_to_vec_env_v1(encoded())
    envs = supersuit.concat_vec_envs_v1(vectors, 2, num_cpus=1, base_class="gymnasium")
    seen, _ = envs.reset(seed=0)
    assert seen.shape == (4, *encoded().observation_space("giver").shape)
    for _ in range(8):  # more steps than an episode has
        seen, rewards, ended, timed_out, _ = envs.step(np.zeros((4, 8), np.float32))
    assert rewards.shape == ended.shape == timed_out.shape == (4,)
    np.testing.assert_array_equal(seen[:, -2:], np.tile(np.eye(2), (2, 1)))
    envs.close()
