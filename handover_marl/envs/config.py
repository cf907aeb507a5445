"""Configuration of the two-agent handover environment."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP, CameraConfig, WorldConfig, check_config
from handover_marl.envs.arguments import check_positive_integer
from handover_marl.envs.custom_rewards import RewardLike, resolve_rewards
from handover_marl.episode.camera_observations import WristCameraConfig
from handover_marl.episode.spaces import STATE, check_obs_mode, get_camera_data_kind
from handover_marl.errors import OptionError, check_name
from handover_marl.geometry.panda import PANDA
from handover_marl.simulation.camera.noise import CameraNoise
from handover_marl.simulation.camera.optics import HANDOVERSIM_MODEL
from handover_marl.simulation.camera.renderers import check_rendering, resolve_renderer
from handover_marl.simulation.engines import check_physics

RENDER_MODES = ("human", "rgb_array")
_LONGEST_PERIOD = 3_600_000  # physics steps, one hour


@dataclass(frozen=True)
class EnvConfig:
    """Configuration of the handover environment, shared by all its constructors.

    Attributes:
        setup: Setup of the data set; default: its first setup. Official setups are "s0" (default) to "s3".
        split: "train", "val" or "test".
        data_dir: Folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        dataset: "dexycb", "synthetic", "generated:n=N,seed=S", "own:FOLDER" (custom scenes in a folder), or
            "auto": DexYCB if there is a data folder, else synthetic. See `handover_marl.datasets.registry`.
        physics: "exact" is HandoverSim's simulation bit for bit; "fast", for training, simulates hand
            and objects only while the robot is near them; "mujoco" is MuJoCo in place of
            PyBullet, faster still.
        control_period: Time for which an action holds (s); a whole number of milliseconds.
        render_mode: None, "rgb_array" (needs no screen) or "human" (PyBullet's window).
        camera: Camera of the "rgb_array" images.
        rewards: Preset rewards "sparse", 1 for a completed handover, or "shaped", with potential-based
            shaping and costs in addition; a `RewardConfig`, weights of the terms of preset rewards;
            `TermWeights`, weights of reward terms that can be combined freely and have no discount; a function
            of a `Transition` that returns terms by agent; a combination (`combine_rewards`); or the text
            `module:name` that names one of these. Success is the term `task` of preset rewards and the
            reward term `success`, so that a combination can have both.
        scenes: Scene numbers to draw from; default: the whole split.
        max_cycles: Control steps after which an episode is truncated; default: never.
        world_config: Simulated world, protocol and limits of the giver.
        robot: "panda", or "panda_camera" with HandoverSim's depth camera on its hand.
        obs_mode: Observation mode of the receiver: "state", "pointcloud", "scene_pointcloud", "rgbd",
            "full_pointcloud", or "state+" and one of the last four; both robots have a wrist camera.
        renderer: Renderer of the wrist camera: "bullet" (PyBullet), "rays" (ray casting), or
            "auto": bullet in exact physics, rays otherwise.
        camera_model: "handoversim" shifts points by one pixel as HandoverSim does, "pinhole" does not.
        camera_noise: Noise of the wrist camera: None, "realsense" or a `CameraNoise`.

    Raises:
        UnknownNameError: There is no such physics, observation mode, reward, renderer, camera or
            render mode.
        OptionError: `control_period` or `max_cycles` is out of range, or a package is missing that
            rendering needs.
    """

    setup: str | None = None
    split: str = "train"
    data_dir: str | os.PathLike[str] | None = None
    dataset: str = "auto"
    physics: str = "exact"
    control_period: float = 0.1
    render_mode: str | None = None
    camera: CameraConfig | None = None
    rewards: RewardLike = "sparse"
    scenes: Iterable[int] | None = None
    max_cycles: int | None = None
    world_config: WorldConfig = OFFICIAL_CONFIG
    robot: str = PANDA
    obs_mode: str = STATE
    renderer: str = "auto"
    camera_model: str = HANDOVERSIM_MODEL
    camera_noise: str | CameraNoise | None = None

    def __post_init__(self) -> None:
        if isinstance(self.scenes, Iterable):
            # Iterators can be read only once.
            object.__setattr__(self, "scenes", tuple(self.scenes))
        if self.render_mode is not None:
            check_name("render_mode", self.render_mode, RENDER_MODES)
        check_physics(self.physics)
        check_config("world_config", self.world_config, WorldConfig)
        if self.camera is not None:
            check_config("camera", self.camera, CameraConfig)
        if self.render_mode is not None:
            check_rendering(f"render_mode={self.render_mode!r}")
        check_obs_mode(self.obs_mode)
        camera = self.wrist_camera
        if get_camera_data_kind(self.obs_mode) is not None:
            resolve_renderer(camera.renderer, self.physics)
        resolve_rewards(self.rewards)
        _count_physics_steps(self.control_period)
        if self.max_cycles is not None:
            check_positive_integer("max_cycles", self.max_cycles)

    @property
    def control_steps(self) -> int:
        """Physics steps (1 ms) in a control period."""
        return _count_physics_steps(self.control_period)

    @property
    def wrist_camera(self) -> WristCameraConfig:
        """Configuration of the wrist camera."""
        return WristCameraConfig(self.renderer, self.camera_model, self.camera_noise)


def make_env_config(config: EnvConfig | None, fields: Mapping[str, Any]) -> EnvConfig:
    """Return a given environment configuration, or make one from its fields.

    Args:
        config: Configuration to return, or None.
        fields: Fields of `EnvConfig` by name; empty if `config` is given.

    Raises:
        OptionError: Both `config` and `fields` are given, or a value is out of range.
        UnknownNameError: The value of a field is not one of its valid names.
    """
    if config is None:
        return EnvConfig(**fields)
    if not isinstance(config, EnvConfig):
        raise OptionError(f"config must be an EnvConfig, got {config!r}; pass its fields as keywords")
    if fields:
        raise OptionError(f"pass either a config or keyword arguments, not both; got config and {', '.join(fields)}")
    return config


def _count_physics_steps(control_period: float) -> int:
    try:
        steps = 0 if isinstance(control_period, bool) else round(control_period / TIME_STEP)
    except (TypeError, ValueError, OverflowError):
        steps = 0
    if not 1 <= steps <= _LONGEST_PERIOD or abs(steps * TIME_STEP - control_period) > 1e-9:
        raise OptionError(
            f"control_period must be a whole number of milliseconds, in seconds, got {control_period!r}; "
            "take 0.1 or 0.001"
        )
    return steps
