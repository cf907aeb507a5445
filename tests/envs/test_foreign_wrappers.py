"""Tests of wrappers and vector environments of PettingZoo and Gymnasium, and of wrappers in vector environments."""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils.wrappers import BaseParallelWrapper

import handover_marl
from handover_marl.config import CameraConfig, ProtocolConfig, WorldConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.envs.wrappers.wrapper import EpisodeReturns
from handover_marl.errors import OptionError
from tests.envs.custom_rewards import approach
from tests.helpers.equality import assert_equal

OPTIONS: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val", "max_cycles": 6}
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


def make() -> HandoverEnv:
    return handover_marl.parallel_env(**OPTIONS)


def test_a_wrapper_changes_what_the_learner_gets_and_not_the_partner() -> None:
    plain = handover_marl.freeze(make(), "receiver", "cooperative")
    shifted = handover_marl.freeze(Cost(make()), "receiver", "cooperative")
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
    pytest.importorskip("mujoco", reason="needs MuJoCo")
    options = {**OPTIONS, "physics": physics}
    envs = handover_marl.vector_env(2, agent, wrappers=[Cost, EpisodeReturns], threads=1, **options)
    alone = EpisodeReturns(Cost(handover_marl.parallel_env(**options)))
    observations, _ = envs.reset(seed=4)
    expected, _ = alone.reset(seed=5)
    still = {"giver": np.zeros((2, 8), np.float32), "receiver": np.zeros((2, 9), np.float32)}
    for _ in range(6):
        own = observations if agent else observations["receiver"]
        for key, value in expected["receiver"].items():
            np.testing.assert_array_equal(own[key][1], value)
        observations, rewards, _, _, infos = envs.step(still["receiver"] if agent else still)
        expected, expected_rewards, _, _, expected_infos = alone.step({key: value[1] for key, value in still.items()})
        own_rewards, own_infos = (rewards, infos) if agent else (rewards["receiver"], infos["receiver"])
        assert own_rewards[1] == expected_rewards["receiver"] == -1.0
        assert own_infos["return"][1] == expected_infos["receiver"]["return"]
    envs.close()


@pytest.mark.parametrize(
    ("wrappers", "message"),
    [
        ([5], "wrappers must be functions or classes that wrap an environment, got 5"),
        ("Cost", "wrappers must be a list of functions or classes"),
        ([lambda env: None], "env must be made by"),
        ([lambda env: sys.exit(3)], r"wrapper .* failed \(SystemExit: 3\)"),
        ([lambda env: make()], "wrappers must wrap the environment that they get"),
    ],
)
def test_wrong_wrappers_are_refused(wrappers: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        handover_marl.vector_env(1, wrappers=wrappers, **OPTIONS)


def test_returns_are_the_sums_of_the_terms() -> None:
    env = EpisodeReturns(handover_marl.parallel_env(**OPTIONS, rewards=approach))
    for _ in range(2):
        _, infos = env.reset(seed=0)
        assert (infos["receiver"]["return/approach"], infos["giver"]["return"]) == (0.0, 0.0)
        total = 0.0
        while env.agents:
            moved = np.full(9, 0.1, np.float32)
            _, rewards, _, _, infos = env.step({"giver": np.zeros(8), "receiver": moved})
            total += rewards["receiver"]
            assert infos["receiver"]["return/approach"] == infos["receiver"]["return"] == total != 0.0
            assert infos["receiver"]["reward/approach"] == rewards["receiver"]
    env.close()


def test_make_vec_uses_the_vector_environment() -> None:
    pytest.importorskip("mujoco", reason="needs MuJoCo")
    options = {**OPTIONS, "partner": "replay", "rewards": approach}
    envs = gymnasium.make_vec("HandoverMARL/Receiver-v0", 2, **options)
    assert isinstance(envs, HandoverVectorEnv)
    assert envs.spec is not None
    envs.close()
    giver = gymnasium.make_vec("HandoverMARL/Giver-v0", 1, features="giver", schemes="offer", partner="hold", **OPTIONS)
    assert giver.single_action_space.shape == (7,)
    giver.close()


@pytest.mark.slow
def test_processes_of_gymnasium_repeat_from_their_seed() -> None:
    """Environments in processes equal those in this one, also after more steps than those of an episode."""
    ends = []
    for mode in ("async", "sync"):
        # The name includes the module, so that worker processes import it, whatever their start method.
        options = {**OPTIONS, "split": "train", "vectorization_mode": mode}
        envs = gymnasium.make_vec("handover_marl:HandoverMARL/Receiver-v0", 2, **options)
        envs.action_space.seed(5)
        envs.reset(seed=5)
        ends.append([envs.step(envs.action_space.sample())[:2] for _ in range(8)])
        envs.close()
    assert_equal(*ends)
    poses = ends[0][-1][0]["object_poses"]
    assert not np.array_equal(poses[0], poses[1]), "seeds 5 and 6 differ"


@pytest.mark.slow
def test_videos_have_the_duration_of_the_episode(tmp_path: Path) -> None:
    """Videos have images before the first and after each control period, of which the last may be shorter."""
    ffmpeg: Any = pytest.importorskip("imageio_ffmpeg", reason="needs the extra `render`")
    options = {**OPTIONS, "max_cycles": None, "control_period": 0.15, "render_mode": "rgb_array"}
    options |= {"world_config": WorldConfig(protocol=ProtocolConfig(horizon_steps=600))}
    live = handover_marl.parallel_env(**options, camera=CameraConfig(width=64, height=48))
    env = gymnasium.wrappers.RecordVideo(handover_marl.freeze(live, "giver", "hold", api="gymnasium"), str(tmp_path))
    env.reset(seed=0)
    while not any(env.step(np.zeros(8, dtype=np.float32))[2:4]):
        pass
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert 0.15 - 1e-2 < ffmpeg.count_frames_and_secs(str(video))[1] - 0.6 < 0.3 + 1e-2
