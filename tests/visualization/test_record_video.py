"""Tests of the duration of recorded videos."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP, CameraConfig

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


def test_videos_have_the_duration_of_the_episode(tmp_path: Path) -> None:
    env = handover_marl.freeze(make_env(0.15), "giver", "hold", api="gymnasium")
    play(gymnasium.wrappers.RecordVideo(env, str(tmp_path)))
    # Images before the first and after each control period, of which the last may be shorter.
    (video,) = tmp_path.glob("*.mp4")
    duration, episode = imageio_ffmpeg.count_frames_and_secs(str(video))[1], HORIZON_STEPS * TIME_STEP
    assert 0.15 - 1e-2 < duration - episode < 0.3 + 1e-2
