"""Tests of the duration of recorded videos."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
import pytest
from pettingzoo.utils.wrappers import RecordVideoParallel

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP, CameraConfig
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.learning.action_scheme import ActionScheme

pytestmark = pytest.mark.slow

HORIZON_STEPS = 600
SHORT = replace(OFFICIAL_CONFIG, protocol=replace(OFFICIAL_CONFIG.protocol, horizon_steps=HORIZON_STEPS))


def make_env(control_period: float) -> handover_marl.HandoverEnv:
    return handover_marl.parallel_env(
        dataset="synthetic",
        split="val",
        scenes=[9],
        physics="fast",
        control_period=control_period,
        render_mode="rgb_array",
        camera=CameraConfig(width=64, height=48),
        world_config=SHORT,
    )


def play(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=0)
    done = False
    while not done:
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape or (), dtype=np.float32))
        done = terminated or truncated
    env.close()


def check_duration(folder: Path, control_period: float) -> None:
    """Check that a video has images before the first and after each control period; the last may be shorter."""
    (video,) = folder.glob("*.mp4")
    duration, episode = imageio_ffmpeg.count_frames_and_secs(str(video))[1], HORIZON_STEPS * TIME_STEP
    assert control_period - 1e-2 < duration - episode < 2.0 * control_period + 1e-2


class WaitingScheme(ActionScheme):
    """Scheme that needs outputs from 0.2 s on, every 0.3 s."""

    name, agent, size = "waiting", "receiver", 1

    def needs_outputs(self, observation: Observation) -> bool:
        return round(1000.0 * float(observation["time"][0])) % 300 == 200

    def compute_action(self, observation: Observation) -> npt.NDArray[np.float32]:
        return np.array(WAITING_JOINTS, dtype=np.float32)


def encode(env: Any) -> Any:
    return handover_marl.encode(handover_marl.freeze(env, "receiver"), "receiver", WaitingScheme, api="gymnasium")


def test_videos_have_the_duration_of_the_episode(tmp_path: Path) -> None:
    env = handover_marl.freeze(make_env(0.15), "giver", "hold", api="gymnasium")
    play(gymnasium.wrappers.RecordVideo(env, str(tmp_path)))
    check_duration(tmp_path, 0.15)


def test_videos_of_schemes_that_wait(tmp_path: Path) -> None:
    """Videos have the duration of the episode, too, or a warning names the wrapper that records such ones."""
    env = make_env(0.1)
    recorded = RecordVideoParallel(env, str(tmp_path), fps=env.metadata["render_fps"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        play(encode(recorded))
    check_duration(tmp_path, 0.1)
    with pytest.warns(UserWarning, match="RecordVideoParallel"):
        play(gymnasium.wrappers.RecordVideo(encode(make_env(0.1)), str(tmp_path / "other")))
