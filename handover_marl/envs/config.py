"""Configuration of the two-agent handover environment."""

from dataclasses import dataclass
from numbers import Real
from typing import Any

from handover_marl.config import MAX_CONTROL_PERIOD, CameraConfig, WorldConfig, check_config, count_physics_steps
from handover_marl.envs.custom_rewards import RewardLike, resolve_rewards
from handover_marl.episode.scene_config import SceneConfig
from handover_marl.episode.spaces import STATE, has_camera
from handover_marl.errors import OptionError, check_name
from handover_marl.execution.options import check_positive_integer
from handover_marl.simulation.camera.renderers import check_rendering, resolve_renderer
from handover_marl.simulation.engines import MUJOCO, check_physics

RENDER_MODES = ("human", "rgb_array")


@dataclass(frozen=True)
class EnvConfig(SceneConfig):
    """Configuration of the handover environment, shared by all its constructors; adds fields to `SceneConfig`.

    Attributes:
        split: Split of the setup: train, val or test.
        control_period: Time for which an action holds (s); a whole number of milliseconds, at most 5 s.
        render_mode: None, "rgb_array" (needs no screen) or "human" (PyBullet's window, in exact and fast physics).
        camera: Camera of the "rgb_array" images; default: `CameraConfig()`, which shows the scene from the side.
        rewards: Preset "sparse" (1 for a completed handover) or "shaped" (also potential-based shaping and
            costs); `RewardWeights`, the weights of reward terms; a function that returns terms by agent for a
            `Transition`; a combination (`combine_rewards`); or text `module:name` that names one of these.
        max_cycles: Control steps after which an episode is truncated; default: never.
        obs_mode: Observation mode of the receiver: parts joined by "+", such as "state" or "rgb+depth+pointcloud"; see
            `handover_marl.episode.spaces.OBS_PARTS`. Camera parts contain the data of each camera in `cameras`.

    Raises:
        UnknownNameError: There is no such physics, observation mode, reward, renderer, camera or
            render mode.
        OptionError: A field has the wrong type or is out of range, or a package is missing that rendering needs.
    """

    split: str = "train"
    control_period: float = 0.1
    render_mode: str | None = None
    camera: CameraConfig | None = None
    rewards: RewardLike = "sparse"
    max_cycles: int | None = None
    obs_mode: str = STATE

    def __post_init__(self) -> None:
        super().__post_init__()
        check_physics(self.physics)
        check_config("world_config", self.world_config, WorldConfig)
        if self.camera is not None:
            check_config("camera", self.camera, CameraConfig)
        if self.render_mode is not None:
            check_name("render_mode", self.render_mode, RENDER_MODES)
            if self.render_mode == "human" and self.physics == MUJOCO:
                raise OptionError(
                    "render_mode must be 'rgb_array' with physics 'mujoco', which has no window, got 'human'"
                )
            check_rendering(f"render_mode={self.render_mode!r}")
        sensors = self.sensors
        if has_camera(self.obs_mode):
            resolve_renderer(sensors.renderer, self.physics)
            if not sensors.cameras:
                raise OptionError(f"cameras must not be empty with obs_mode={self.obs_mode!r}, got (); name a camera")
        resolve_rewards(self.rewards)
        period: Any = self.control_period
        is_number = isinstance(period, Real) and not isinstance(period, bool)
        if not is_number or not 0.001 <= period <= MAX_CONTROL_PERIOD:
            rule = f"control_period must be a time from 0.001 to {MAX_CONTROL_PERIOD:g} s"
            raise OptionError(f"{rule}, got {period!r}; for 100 ms pass 0.1")
        count_physics_steps("control_period", float(period))
        # Not a number of NumPy, since policies are saved with the control period.
        object.__setattr__(self, "control_period", round(float(period), 3))
        if self.max_cycles is not None:
            check_positive_integer("max_cycles", self.max_cycles)

    @property
    def control_steps(self) -> int:
        """Physics steps (1 ms) in a control period."""
        return count_physics_steps("control_period", self.control_period)
