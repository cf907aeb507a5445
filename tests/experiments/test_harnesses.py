"""Tests of the environments for LeRobot and vla-eval; `make lerobot` installs both, without which some are skipped."""

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import handover_marl
from experiments.harnesses.lerobot_env import LeRobotEnv, make_env
from tests.helpers.lerobot import prepare_lerobot
from tests.learning.training.scripts import script

pytest.importorskip("embreex", reason="needs the extra `vision`")


@pytest.mark.slow
@pytest.mark.parametrize(("obs_mode", "has_state"), [("rgb", False), ("state+rgb", True)])
def test_observations_have_the_names_of_lerobot(obs_mode: str, has_state: bool) -> None:
    env = LeRobotEnv("s0/train", obs_mode=obs_mode, dataset="synthetic", max_cycles=2)
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    assert ("environment_state" in observation) is has_state
    assert info["is_success"] is False
    assert env.task_description.startswith("Take the ")
    np.testing.assert_array_equal(env.render(), observation["pixels"]["wrist"])
    for truncates in (False, True):
        observation, _, terminated, truncated, info = env.step(observation["agent_pos"])
        assert (terminated, truncated, info["is_success"]) == (False, truncates, False)
    env.close()


def test_make_env_gives_a_vector_environment_with_autoreset() -> None:
    envs = make_env(2)["handover"][0]
    assert isinstance(envs, SyncVectorEnv)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert envs.call("_max_episode_steps") == (260, 260)
    observations, _ = envs.reset(seed=[0, 1])
    assert observations["pixels"]["wrist"].shape == (2, 224, 224, 3)
    envs.close()


def make_act_policy(folder: Path, obs_mode: str = "rgb") -> Any:
    """Save and return a small ACT policy with random weights for an observation mode, and its processors."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    features = {"observation.state": PolicyFeature(FeatureType.STATE, (9,))}
    if "rgb" in obs_mode:
        features["observation.images.wrist"] = PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
    if "state" in obs_mode:
        features["observation.environment_state"] = PolicyFeature(FeatureType.ENV, (146,))
    output = {"action": PolicyFeature(FeatureType.ACTION, (9,))}
    sizes = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
    chunks = {"chunk_size": 4, "n_action_steps": 2}
    config = ACTConfig(
        input_features=features,
        output_features=output,
        pretrained_backbone_weights=None,
        device="cpu",
        **sizes,
        **chunks,
    )
    policy = ACTPolicy(config)
    processors = make_pre_post_processors(config)
    for part in (policy, *processors):
        part.save_pretrained(folder)
    return policy, *processors


@pytest.mark.slow
def test_lerobot_evaluates_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_lerobot()
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.scripts.lerobot_eval import eval_policy

    policy, preprocess, postprocess = make_act_policy(tmp_path)
    envs = SyncVectorEnv(
        [lambda: LeRobotEnv("s0/train", dataset="synthetic", max_cycles=3)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    same = PolicyProcessorPipeline(steps=[])
    found = eval_policy(envs, policy, same, same, preprocess, postprocess, n_episodes=2, start_seed=0)
    assert found["aggregated"]["pc_success"] == 0.0
    envs.close()
    observation, _ = LeRobotEnv("s0/train", dataset="synthetic").reset(seed=0)
    robot = script("lerobot_receiver", monkeypatch).LeRobotReceiver(None, str(tmp_path))
    robot.reset(seed=0)
    state = {"wrist_rgb": observation["pixels"]["wrist"], "robot_joint_position": observation["agent_pos"]}
    assert robot.act(state).shape == (9,)


@pytest.mark.slow
@pytest.mark.parametrize("obs_mode", ["state", "rgb+state"])
def test_the_receiver_observes_what_its_policy_was_trained_with(
    obs_mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare_lerobot()
    make_act_policy(tmp_path, obs_mode)
    receiver = script("lerobot_receiver", monkeypatch).LeRobotReceiver(None, str(tmp_path))
    assert receiver.obs_mode == obs_mode
    env = handover_marl.parallel_env(dataset="synthetic", physics="mujoco", obs_mode=obs_mode)
    observations, _ = env.reset(seed=0)
    receiver.reset(seed=0)
    actions = [receiver.act(observations["receiver"])]
    receiver.reset(seed=0)
    observations["receiver"]["object_poses"] += 1.0
    actions.append(receiver.act(observations["receiver"]))
    assert actions[0].shape == (9,)
    assert not np.array_equal(*actions)
    env.close()


class StandingModel:
    """Model server's connection, whose model does not move."""

    async def start_episode(self, payload: dict[str, Any]) -> None:
        assert payload["task"]["name"].startswith("scene ")

    async def act(self, observation: dict[str, Any]) -> dict[str, Any]:
        assert observation["images"]["wrist"].shape == (224, 224, 3)
        assert observation["task_description"].startswith("Take the ")
        return {"actions": np.zeros((1, 7))}

    async def end_episode(self, result: dict[str, Any]) -> None:
        assert result["metrics"] == {"success": False, "contact": 0.0}


@pytest.mark.slow
def test_vla_eval_runs_an_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    runners = pytest.importorskip("vla_eval.runners.sync_runner")
    module = script("vla_eval_benchmark", monkeypatch)
    benchmark = module.HandoverBenchmark(split="train", physics="mujoco", dataset="synthetic", max_cycles=3)
    runner, task = runners.SyncEpisodeRunner(), benchmark.get_tasks()[0]
    result = asyncio.run(runner.run_episode(benchmark, task, StandingModel(), max_steps=5))
    assert result["steps"] == 3
    held = benchmark.get_hold_action({"actions": np.ones(7)})["actions"]
    assert held.tolist() == [0.0] * 6 + [1.0]
    benchmark.cleanup()
