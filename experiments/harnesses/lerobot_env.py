"""Environments for LeRobot: publish this file as `env.py` of a repository of the Hugging Face Hub (EnvHub).

LeRobot calls `make_env`; its Python environment needs `handover_marl` with the extra `vision`. Observations have the
same names as in data sets by `handover-marl convert --to lerobot`: image of the wrist camera, joints of the robot and,
with "state" in `obs_mode`, the true state of objects and hand.
"""

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

import handover_marl
from handover_marl import EpisodeStatus
from handover_marl.config import TIME_STEP, ProtocolConfig
from handover_marl.episode.spaces import has_state
from handover_marl.evaluation.demonstrations.convert import ENVIRONMENT_KEYS, describe_task

FPS = 20
Observation = dict[str, Any]


class LeRobotEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """Environment of the receiver with LeRobot's names; the giver replays recordings.

    Args:
        task: Setup and split of the scenes, such as "s0/val".
        fps: Decisions per second: the frame rate of the demonstrations.
        obs_mode: Observation mode; it must contain "rgb".
        options: Other arguments of `handover_marl.parallel_env`.

    Attributes:
        task_description: Task in words, with the object's name; empty before the first reset.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"

    def __init__(self, task: str = "s0/val", fps: int = FPS, obs_mode: str = "rgb", **options: Any) -> None:
        setup, _, split = task.partition("/")
        self._handover = handover_marl.parallel_env(
            setup=setup, split=split, obs_mode=obs_mode, control_period=1.0 / fps, **{"physics": "mujoco"} | options
        )
        self._env = handover_marl.control_agent(self._handover, "receiver", "replay", api="gymnasium")
        self.task, self.task_description = task, ""
        self._max_episode_steps = round(ProtocolConfig().horizon_steps * TIME_STEP * fps)
        self.action_space = self._env.action_space
        inner, self._has_state = self._env.observation_space, has_state(obs_mode)
        found = {"pixels": spaces.Dict({"wrist": inner["wrist_rgb"]}), "agent_pos": inner["robot_joint_position"]}
        if self._has_state:
            state = spaces.Dict({key: inner[key] for key in ENVIRONMENT_KEYS})
            found["environment_state"] = spaces.Box(-np.inf, np.inf, (spaces.flatdim(state),), np.float32)
        self.observation_space = spaces.Dict(found)
        self._image = np.zeros(inner["wrist_rgb"].shape, np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Any]:
        """Start an episode in a scene drawn with the seed, or in the scene of `options={"scene_id": number}`."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed, options=options)
        self.task_description = describe_task(self._handover.object_names[0])
        return self._rename(observation), {**info, "is_success": False}

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply target joint positions (9,), 7 of the arm (rad) and 2 of the fingers (m), for 1 / `fps` s."""
        observation, reward, terminated, truncated, info = self._env.step(action)
        success = info["status"] == int(EpisodeStatus.SUCCESS)
        return self._rename(observation), reward, terminated, truncated, {**info, "is_success": success}

    def render(self) -> npt.NDArray[np.uint8]:
        return self._image

    def close(self) -> None:
        self._env.close()

    def _rename(self, observation: Observation) -> Observation:
        self._image = observation["wrist_rgb"]
        found = {"pixels": {"wrist": self._image}, "agent_pos": observation["robot_joint_position"]}
        if self._has_state:
            found["environment_state"] = join_environment_state(observation)
        return found


def join_environment_state(observation: Observation) -> npt.NDArray[np.float32]:
    """Return the true state of objects and hand (146,) in a receiver's observation, in the order of the data sets."""
    return np.concatenate([observation[key].ravel() for key in ENVIRONMENT_KEYS])


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
    """Make the environments that LeRobot asks for, as `{"handover": {0: vector_environment}}`.

    Args:
        n_envs: Number of environments.
        use_async_envs: Whether each environment has a process of its own.
        cfg: LeRobot's configuration, of which only `task` and `fps` are used; None: default values.
    """
    given = {name: getattr(cfg, name) for name in ("task", "fps") if getattr(cfg, name, None)}
    kind = gymnasium.vector.AsyncVectorEnv if use_async_envs else gymnasium.vector.SyncVectorEnv
    envs = kind([lambda: LeRobotEnv(**given)] * n_envs, autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP)
    return {"handover": {0: envs}}
