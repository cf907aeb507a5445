"""Tests of the giver as an agent of the environment."""

from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.config import PandaConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.episode.referee import RELEASE_REASONS, EpisodeStatus, ReleaseReason

START = np.array(PandaConfig().start_joints, dtype=np.float32)
SCENE = 209


def make() -> HandoverEnv:
    env: HandoverEnv = handover_marl.parallel_env(split="test", dataset="synthetic", physics="fast")
    env.reset(seed=0, options={"scene_id": SCENE})
    return env


def giver(rate: float = 0.0, shift: Any = (0, 0, 0), turn: Any = (0, 0, 0), release: float = 0.0) -> np.ndarray:
    return np.array([rate, *shift, *turn, release], dtype=np.float32)


def act(env: HandoverEnv, action: np.ndarray, steps: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    for _ in range(steps):
        observations, *_, infos = env.step({"giver": action, "receiver": START})
        if not env.agents:
            break
    return observations["giver"], infos["giver"]


@pytest.mark.slow
def test_the_world_follows_the_deviation_and_letting_go_drops_the_object() -> None:
    env = make()
    before, _ = act(env, giver(), 28)
    assert before["holding"] == 1
    shift = np.float32([0.1, -0.15, 0.05])
    after, info = act(env, giver(shift=shift), 12)
    np.testing.assert_allclose(after["hand_keypoints"] - before["hand_keypoints"], np.tile(shift, (16, 1)), atol=5e-3)
    np.testing.assert_allclose(after["object_poses"][0, :3] - before["object_poses"][0, :3], shift, atol=5e-3)
    np.testing.assert_allclose(after["object_poses"][1:], before["object_poses"][1:], atol=1e-4)
    np.testing.assert_allclose(after["deviation"], [0, *shift, 0, 0, 0], atol=1e-6)
    assert info["status"] == EpisodeStatus.RUNNING
    seen, info = act(env, giver(shift=shift, release=1.0), 1)
    assert seen["released"] == 1
    assert RELEASE_REASONS[int(info["release"])] is ReleaseReason.VOLUNTARY
    assert info["release_step"] == 4000
    height = seen["object_poses"][0, 2]
    seen, info = act(env, giver(shift=shift, release=1.0), 20)
    assert seen["object_poses"][0, 2] < height - 0.1
    assert info["status"] == EpisodeStatus.OBJECT_DROP


def test_what_is_not_held_cannot_be_let_go() -> None:
    env = make()
    seen, info = act(env, giver(release=1.0), 1)
    assert seen["released"] == 0
    assert info["release"] == info["release_step"] == -1
