"""Tests of environments in several processes, as training libraries run them."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl.config import CameraConfig
from handover_marl.errors import OptionError

# The name includes the module, so that worker processes import it, whatever their start method.
NAME = "handover_marl:HandoverMARL/Receiver-v0"
OPTIONS: dict[str, Any] = {"setup": "s0", "dataset": "synthetic", "physics": "fast", "max_cycles": 6}
STEPS = 8  # more than the 6 steps of an episode

Rollout = tuple[dict[str, np.ndarray], np.ndarray]


def make_gymnasium_envs(n: int) -> Any:
    return gymnasium.make_vec(NAME, num_envs=n, vectorization_mode="async", **OPTIONS)


def gymnasium_rollout(envs: Any, seed: int, steps: int) -> Rollout:
    envs.action_space.seed(seed)
    envs.reset(seed=seed)
    total = np.zeros(envs.num_envs)
    for _ in range(steps):
        seen, rewards, _, _, _ = envs.step(envs.action_space.sample())
        total += rewards
    return seen, total


def make_sb3_envs(n: int) -> Any:
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env", reason="needs the extra `train`")
    return vec_env.SubprocVecEnv([lambda: gymnasium.make(NAME, **OPTIONS)] * n)


def sb3_rollout(envs: Any, seed: int, steps: int) -> Rollout:
    envs.seed(seed)
    envs.reset()
    rng = np.random.default_rng(seed)
    low, high = envs.action_space.low, envs.action_space.high
    total = np.zeros(envs.num_envs)
    for _ in range(steps):
        actions = rng.uniform(low, high, (envs.num_envs, len(low))).astype(np.float32)
        seen, rewards, _, _ = envs.step(actions)
        total += rewards
    return seen, total


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "rollout", "is_made_again"),
    # Processes of Stable-Baselines3 import PyTorch, which takes seconds.
    [(make_gymnasium_envs, gymnasium_rollout, True), (make_sb3_envs, sb3_rollout, False)],
)
def test_runs_repeat_from_their_seed(
    make: Callable[[int], Any], rollout: Callable[[Any, int, int], Rollout], is_made_again: bool
) -> None:
    envs = make(2)
    first = rollout(envs, 5, STEPS)
    if is_made_again:
        envs.close()
        envs = make(2)
    again = rollout(envs, 5, STEPS)
    envs.close()
    for key, value in first[0].items():
        np.testing.assert_array_equal(value, again[0][key])
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[0]["object_poses"][0], first[0]["object_poses"][1]), "seeds 5 and 6 differ"
    assert first[0]["object_poses"].shape == (2, 5, 7)


def test_images_are_rendered_only_in_the_mode_for_images() -> None:
    options: dict[str, Any] = {**OPTIONS, "camera": CameraConfig(width=64, height=48)}
    without = handover_marl.vector_env(2, **options)
    without.reset(seed=0)
    assert without.render() is None
    without.close()
    envs = handover_marl.vector_env(2, render_mode="rgb_array", **options)
    envs.reset(seed=0)
    images = envs.render()
    envs.close()
    assert images is not None
    assert [image.shape for image in images] == [(48, 64, 3)] * 2


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_vector_environments_cannot_be_copied(copied: Callable[[object], object]) -> None:
    envs = handover_marl.vector_env(2, **OPTIONS)
    with pytest.raises(OptionError, match="make another one"):
        copied(envs)
    envs.close()
