"""Tests of encoded environments: the checks of Gymnasium, PettingZoo and Stable-Baselines3, seeds and errors."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.wrappers.encode import EncodedEnv, encode
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SceneError, UnknownNameError

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def encoded(agent: str, partner: str, actions: str | None = None, **options: Any) -> EncodedEnv:
    return encode(freeze(parallel_env(**SYNTHETIC, **options), agent, partner), schemes=actions)


def single(agent: str, partner: str, actions: str | None = None, **options: Any) -> SingleAgentEnv:
    return encode(freeze(parallel_env(**SYNTHETIC, **options), agent, partner), schemes=actions, api="gymnasium")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "partner", "actions"),
    [("receiver", "cooperative", "cartesian_delta"), ("giver", "hold", "deviation")],
)
def test_gymnasium_and_stable_baselines_accept_it(agent: str, partner: str, actions: str) -> None:
    env = single(agent, partner, actions, max_cycles=5)
    check_env(env, skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra `train`")
    sb3.check_env(env, warn=False)
    env.close()


def rollout(seed: int, episodes: int) -> list[np.ndarray]:
    env = single("receiver", "noisy", control_period=0.2, max_cycles=6)
    rng = np.random.default_rng(0)
    way = []
    for episode in range(episodes):
        seen, _ = env.reset(seed=seed if episode == 0 else None)
        way.append(seen)
        over = False
        while not over:
            seen, reward, ended, timed_out, _ = env.step(rng.uniform(-1, 1, 7).astype(np.float32))
            way.append(np.append(seen, reward))
            over = ended or timed_out
    env.close()
    return way


@pytest.mark.slow
def test_rollouts_repeat_from_their_seed() -> None:
    first = rollout(3, 2)
    for one, other in zip(first, rollout(3, 2), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first[1], rollout(4, 1)[1])


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


def test_scenes_can_be_kept_for_testing() -> None:
    env = single("receiver", "replay", scenes=[9, 14])
    assert env.scene_ids == (9, 14)
    assert {env.reset(seed=seed)[1]["scene_id"] for seed in range(6)} == {9, 14}
    with pytest.raises(SceneError, match="scene 10 is not in s0 val"):
        single("receiver", "replay", scenes=[9, 10])


@pytest.mark.parametrize(
    ("wrap", "error", "message"),
    [
        (lambda world, view: encode(view, "giver"), UnknownNameError, "features of the receiver 'giver'"),
        (lambda world, view: encode(view, schemes="offer"), UnknownNameError, "scheme of the receiver 'offer'"),
        (lambda world, view: encode(view, api="gym"), UnknownNameError, "api 'gym'; valid: parallel, gymnasium"),
        (lambda world, view: encode(view, {"giver": "giver"}), OptionError, "for receiver, got a choice for 'giver'"),
        (lambda world, view: encode(world, "receiver"), OptionError, "by agent for 2 agents"),
        (lambda world, view: encode(view, 5), OptionError, "features must be a name, a class or a function"),
        (lambda world, view: encode(world, api="gymnasium"), OptionError, "one agent, got giver and receiver"),
        (lambda world, view: freeze(encode(world), "receiver"), OptionError, "must not be encoded"),
        (lambda world, view: encode(encode(view)), OptionError, "encode once, before flattening"),
        (lambda world, view: encode(view).step({"receiver": np.zeros(7)}), ResetNeededError, "call reset"),
    ],
)
def test_wrong_use(wrap: Callable[[Any, Any], Any], error: type[Exception], message: str) -> None:
    world = parallel_env(**SYNTHETIC)
    with pytest.raises(error, match=message):
        wrap(world, freeze(world, "receiver", "replay"))


def test_camera_data_alone_cannot_be_encoded() -> None:
    world = parallel_env(obs_mode="pointcloud", **SYNTHETIC)
    with pytest.raises(OptionError, match=r"obs_mode must include the state .*'state\+pointcloud'"):
        encode(world)
    encode(freeze(world, "giver", "hold"))
    encode(parallel_env(**{**SYNTHETIC, "obs_mode": "state+pointcloud"}))


def test_tensors_with_a_gradient_are_refused_with_advice() -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    env = encoded("receiver", "replay")
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"got Tensor with a gradient or on a GPU; pass tensor\.detach\(\)\.cpu\(\)"):
        env.step({"receiver": torch.zeros(7, requires_grad=True)})


@pytest.mark.parametrize("actions", [None, {}, {"receiver": np.zeros(6)}, {"receiver": np.full(7, np.nan)}])
def test_malformed_outputs_leave_the_world_alone(actions: Any) -> None:
    env = encoded("receiver", "replay")
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ActionError, match="outputs of the receiver must be 7 numbers"):
        env.step(actions)
    np.testing.assert_array_equal(before, env.state())
    assert env.step({"receiver": np.zeros(7)})[4]["receiver"]["steps"] == 100


def test_copies_go_their_own_way() -> None:
    env = encoded("receiver", "noisy", "joint_delta")
    copy = pickle.loads(pickle.dumps(env))
    assert copy.scheme_names == {"receiver": "joint_delta"}
    ends = []
    for one in (env, copy):
        one.reset(seed=3)
        for _ in range(3):
            seen = one.step({"receiver": np.full(8, 0.1, np.float32)})[0]
        ends.append(seen["receiver"])
        one.close()
    np.testing.assert_array_equal(*ends)


@pytest.mark.slow
def test_both_agents() -> None:
    env = encode(parallel_env(**SYNTHETIC, max_cycles=6), {"receiver": "grasp"})
    parallel_api_test(env, num_cycles=8)
    parallel_seed_test(lambda: encode(parallel_env(**SYNTHETIC, max_cycles=6)), num_cycles=3)
    env.reset(seed=0)
    zeros = {agent: np.zeros(env.action_space(agent).shape, np.float32) for agent in env.possible_agents}
    steps = 0
    while env.agents:
        *_, ended, timed_out, _ = env.step(zeros)
        steps += 1
    assert steps == 6
    assert all(timed_out.values())
    assert not any(ended.values())
    with pytest.raises(ResetNeededError):
        env.step(zeros)
