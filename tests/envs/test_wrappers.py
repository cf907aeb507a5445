"""Tests of wrappers: encoded environments, and wrappers of PettingZoo and Gymnasium."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils.wrappers import BaseParallelWrapper

import handover_marl
from handover_marl.config import CameraConfig, ProtocolConfig, WorldConfig
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.envs.wrappers.control_agent import control_agent
from handover_marl.envs.wrappers.encode import EncodedEnv, encode
from handover_marl.errors import ActionError, OptionError, ResetNeededError, UnknownNameError
from tests.envs.custom_rewards import approach
from tests.envs.test_handover_env import SYNTHETIC
from tests.helpers.equality import assert_equal

OPTIONS: dict[str, Any] = {**SYNTHETIC, "max_cycles": 6}
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


class Cost(BaseParallelWrapper):
    """Wrapper made for PettingZoo only; it subtracts 1 from each reward and shifts the receiver's gripper pose."""

    metadata = {"name": "cost"}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._shift(observations), infos

    def step(self, actions: Any) -> Any:
        observations, rewards, *rest = self.env.step(actions)
        return self._shift(observations), {agent: reward - 1.0 for agent, reward in rewards.items()}, *rest

    def _shift(self, observations: Any) -> Any:
        receiver = observations["receiver"]
        shifted = {**receiver, "gripper_pose": receiver["gripper_pose"] + np.float32([1, 0, 0, 0, 0, 0, 0])}
        return {**observations, "receiver": shifted}


class Limit(BaseParallelWrapper):
    """Wrapper that truncates an episode after `limit` control steps; the last infos have their number, "length"."""

    limit = 2

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any) -> Any:
        self.count += 1
        observations, rewards, ended, cut_off, infos = self.env.step(actions)
        own = {"length": self.count} if self.count >= self.limit else {}
        infos = {agent: info | own for agent, info in infos.items()}
        return observations, rewards, ended, dict.fromkeys(cut_off, bool(own)), infos


def make() -> HandoverEnv:
    return handover_marl.parallel_env(**OPTIONS)


@pytest.mark.slow
def test_a_wrapper_changes_what_the_learner_gets_and_not_the_partner() -> None:
    plain = handover_marl.control_agent(make(), "receiver", "cooperative")
    shifted = handover_marl.control_agent(Cost(make()), "receiver", "cooperative")
    for env in (plain, shifted):
        env.reset(seed=3)
    action = {"receiver": np.zeros(9, np.float32)}
    for _ in range(6):
        one, other = plain.step(action), shifted.step(action)
        np.testing.assert_array_equal(
            one[0]["receiver"]["gripper_pose"] + np.float32([1, 0, 0, 0, 0, 0, 0]), other[0]["receiver"]["gripper_pose"]
        )
        np.testing.assert_array_equal(one[0]["receiver"]["object_poses"], other[0]["receiver"]["object_poses"])
        assert other[1]["receiver"] == one[1]["receiver"] - 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("physics", "agent"), [("fast", None), ("mujoco", "receiver")])
def test_vector_environments_are_wrapped(physics: str, agent: str | None) -> None:
    options = {**OPTIONS, "physics": physics}
    envs = handover_marl.vector_env(2, agent, wrappers=[Cost], threads=1, **options)
    alone = Cost(handover_marl.parallel_env(**options))
    observations, _ = envs.reset(seed=4)
    expected, _ = alone.reset(seed=5)
    still = {"giver": np.zeros((2, 8), np.float32), "receiver": np.zeros((2, 9), np.float32)}
    for _ in range(6):
        own = observations if agent else observations["receiver"]
        for key, value in expected["receiver"].items():
            np.testing.assert_array_equal(own[key][1], value)
        observations, rewards, *_ = envs.step(still["receiver"] if agent else still)
        expected, expected_rewards, *_ = alone.step({key: value[1] for key, value in still.items()})
        own_rewards = rewards if agent else rewards["receiver"]
        assert own_rewards[1] == expected_rewards["receiver"] == -1.0
    envs.close()


def test_wrappers_end_episodes_in_which_decisions_are_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("handover_marl.envs.wrappers.encode.MAX_EPISODES_WITHOUT_OUTPUTS", 2)
    env = encode(control_agent(Limit(parallel_env(**SYNTHETIC)), "giver", "hold"), "giver", "offer")
    with pytest.raises(OptionError, match=r"in 2 episodes in a row; .* max_cycles"):
        env.reset(seed=0, options={"scene_id": 9})
    monkeypatch.setattr(Limit, "limit", 30)
    env.reset(seed=0, options={"scene_id": 9})
    *_, cut_off, infos = env.step({"giver": np.zeros(7)})
    assert (cut_off["giver"], infos["giver"]["steps"]) == (True, 3000)


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_infos_that_some_steps_lack_have_masks(autoreset: str) -> None:
    envs = handover_marl.vector_env(2, None, wrappers=[Limit], autoreset=autoreset, **OPTIONS)
    still = {"giver": np.zeros((2, 8)), "receiver": np.zeros((2, 9))}
    envs.reset(seed=0)
    envs.step(still)
    envs.reset(options={"reset_mask": np.array([False, True])})
    for has_ended in ([True, False], [False, True]):
        info = envs.step(still).infos["giver"]
        if autoreset == "same_step":
            assert not info["_length"].any()
            info = info["final_info"]
        np.testing.assert_array_equal(info["length"], np.multiply(has_ended, 2))
        np.testing.assert_array_equal(info["_length"], has_ended)
    envs.close()


def test_actions_are_ignored_in_the_step_of_a_reset() -> None:
    envs = handover_marl.vector_env(2, None, wrappers=[Limit], **OPTIONS)
    envs.reset(seed=0)
    for number in (0.0, 0.0, np.nan):
        result = envs.step({"giver": np.full((2, 8), number), "receiver": np.full((2, 9), number)})
    assert not np.shares_memory(result.terminated["giver"], result.truncated["giver"])
    assert not result.infos["giver"]["steps"].any()
    envs.close()
    with pytest.raises(ResetNeededError, match="the vector environment is closed"):
        envs.render()


@pytest.mark.parametrize(
    ("wrappers", "message"),
    [
        ([5], "wrappers must be functions or classes that wrap an environment, got 5"),
        ("Cost", "wrappers must be a list of functions or classes"),
        ([lambda env: None], "env must be made by"),
        ([lambda env: sys.exit(3)], r"wrapper .* failed: SystemExit: 3"),
    ],
)
def test_wrong_wrappers_are_refused(wrappers: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        handover_marl.vector_env(1, wrappers=wrappers, **OPTIONS)


def test_make_vec_uses_the_vector_environment() -> None:
    options = {**OPTIONS, "partner": "replay", "rewards": approach}
    envs = gymnasium.make_vec("HandoverMARL/Receiver-v0", 2, **options)
    assert isinstance(envs, HandoverVectorEnv)
    assert envs.spec is not None
    envs.close()
    options = {**OPTIONS, "features": "giver", "action_scheme": "offer", "partner": "hold"}
    giver = gymnasium.make_vec("HandoverMARL/Giver-v0", 1, **options)
    assert giver.single_action_space.shape == (7,)
    giver.close()


@pytest.mark.slow
def test_processes_of_gymnasium_repeat_from_their_seed() -> None:
    """Environments in processes equal those in this one, also after more steps than those of an episode."""
    ends = []
    for mode in ("async", "sync"):
        # The name includes the module, so that worker processes import it, whatever their start method.
        options = {**OPTIONS, "split": "train", "vectorization_mode": mode}
        envs = gymnasium.make_vec("handover_marl:HandoverMARL/Receiver-v0", 1, **options)
        envs.action_space.seed(5)
        envs.reset(seed=5)
        ends.append([envs.step(envs.action_space.sample())[:2] for _ in range(8)])
        envs.close()
    assert_equal(*ends)


@pytest.mark.slow
def test_videos_have_the_duration_of_the_episode(tmp_path: Path) -> None:
    """Videos have images before the first and after each control period, of which the last may be shorter."""
    ffmpeg: Any = pytest.importorskip("imageio_ffmpeg", reason="needs the extra `render`")
    options = {**OPTIONS, "max_cycles": None, "control_period": 0.15, "render_mode": "rgb_array"}
    options |= {"world_config": WorldConfig(protocol=ProtocolConfig(horizon_steps=600))}
    live = handover_marl.parallel_env(**options, camera=CameraConfig(width=64, height=48))
    env = gymnasium.wrappers.RecordVideo(control_agent(live, "giver", "hold", api="gymnasium"), str(tmp_path))
    env.reset(seed=0)
    while not any(env.step(np.zeros(8, dtype=np.float32))[2:4]):
        pass
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert 0.15 - 1e-2 < ffmpeg.count_frames_and_secs(str(video))[1] - 0.6 < 0.3 + 1e-2


def encoded(agent: str, partner: str, actions: str | None = None, **options: Any) -> EncodedEnv:
    return encode(control_agent(parallel_env(**SYNTHETIC, **options), agent, partner), action_scheme=actions)


@pytest.mark.slow
def test_rewards_add_up_until_the_next_decision() -> None:
    """The reward of a step that lasts until the end of the episode is the sum over its control periods."""
    options = {"max_cycles": 40, "rewards": "shaped"}
    env = encoded("giver", "hold", "offer", **options)
    world = control_agent(parallel_env(**SYNTHETIC, **options), "giver", "hold")
    _, infos = env.reset(seed=0, options={"scene_id": 9})
    before = infos["giver"]["steps"]
    assert 1000 <= before <= 2500
    assert not any(value for key, value in infos["giver"].items() if key.startswith("reward/"))
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


class _Repeats(BaseParallelWrapper):
    def step(self, actions: Any) -> Any:
        return [super(_Repeats, self).step(actions) for _ in range(3)][-1]


def test_transitions_have_the_actions_that_were_applied() -> None:
    rates = []

    def note(transition: Any) -> dict[str, Any]:
        rates.append(float(transition.actions["giver"][0]) if transition.next_state["time"] > 0 else None)
        return {"receiver": {"none": 0.0}, "giver": {}}

    env = control_agent(_Repeats(parallel_env(**SYNTHETIC, rewards=note)), "receiver", "noisy")
    env.reset(seed=0)
    env.step({"receiver": np.zeros(9)})
    assert len(set(rates)) == 4, "each control period has another action"


@pytest.mark.parametrize(
    ("wrap", "error", "message"),
    [
        (lambda world, view: encode(view, "giver"), UnknownNameError, "features of the receiver 'giver'"),
        (lambda world, view: encode(view, {"giver": "giver"}), OptionError, "for receiver, got a choice for 'giver'"),
        (lambda world, view: encode(world, "receiver"), OptionError, "by agent for 2 agents"),
        (lambda world, view: encode(world, api="gymnasium"), OptionError, "one agent, got giver and receiver"),
        (lambda world, view: control_agent(encode(world), "receiver"), OptionError, "must not be encoded"),
        (lambda world, view: encode(encode(world)), OptionError, "encode once"),
        (lambda world, view: encode(view).step({"receiver": np.zeros(7)}), ResetNeededError, "call reset"),
    ],
)
def test_wrong_use(wrap: Callable[[Any, Any], Any], error: type[Exception], message: str) -> None:
    world = parallel_env(**SYNTHETIC)
    with pytest.raises(error, match=message):
        wrap(world, control_agent(world, "receiver", "replay"))


@pytest.mark.parametrize("actions", [None, {}, {"receiver": np.zeros(6)}, {"receiver": np.full(7, np.nan)}])
def test_malformed_outputs_leave_the_world_alone(actions: Any) -> None:
    env = encoded("receiver", "replay")
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ActionError, match="outputs of the receiver must be 7 numbers"):
        env.step(actions)
    np.testing.assert_array_equal(before, env.state())
    assert env.step({"receiver": np.zeros(7)})[4]["receiver"]["steps"] == 100


def test_observations_that_are_changed_in_place_change_no_action() -> None:
    states = []
    for change in (0.0, 1.0):
        env = encode(control_agent(parallel_env(**SYNTHETIC), "receiver", "replay"), "observation", "joint_delta")
        observations, _ = env.reset(seed=0)
        for _ in range(2):
            observations["receiver"]["robot_joint_position"] += change
            observations = env.step({"receiver": np.zeros(env.action_space("receiver").shape)})[0]
        states.append(env.state())
    np.testing.assert_array_equal(*states)


@pytest.mark.slow
def test_images_of_steps_that_skip_decisions_are_no_video() -> None:
    env = encoded("giver", "hold", "offer", render_mode="rgb_array", camera=CameraConfig(width=8, height=8))
    env.reset(seed=0)
    env.step({"giver": np.zeros(7)})
    with pytest.warns(UserWarning, match="RecordVideoParallel"):
        env.render()


@pytest.mark.parametrize("scheme", [{"receiver": "receiver", "giver": "giver"}, {}])
def test_outputs_of_raw_schemes_are_actions_of_the_environment(scheme: dict[str, str]) -> None:
    world = parallel_env(**SYNTHETIC)
    env = encode(world, action_scheme=scheme)
    for agent in world.possible_agents:
        raw = world.action_space(agent)
        assert (env.action_space(agent) == raw) == (agent in scheme)
        assert not hasattr(raw, "encoding"), "the space of the environment is unchanged"


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
