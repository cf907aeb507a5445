"""Configuration of scenes and simulation, which environments and evaluations share."""

import os
from collections.abc import Iterable
from dataclasses import dataclass

from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.episode.camera_observations import WristCameraConfig
from handover_marl.geometry.panda import PANDA
from handover_marl.simulation.camera.noise import CameraNoise
from handover_marl.simulation.camera.optics import HANDOVERSIM_MODEL


@dataclass(frozen=True)
class SceneConfig:
    """Configuration of scenes and simulation.

    Attributes:
        setup: Official setup: s0 no unseen factor, s1 unseen subjects, s2 unseen handedness, s3 unseen objects; or a
            setup of other data. Default: the first of the dataset, s0 of the official ones.
        split: Split of the setup: train, val or test.
        scenes: Scene numbers of the split, e.g. 209,214; default: all. Reports say if they are partial.
        dataset: Dataset: dexycb, synthetic, generated:n=1000,seed=7 (any number of scenes), own:FOLDER (custom scenes),
            or auto (dexycb if a data folder is found, else synthetic).
        data_dir: Data folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        physics: Physics: exact (official results), fast (hand and objects are simulated only while the robot is near
            them), or mujoco (another engine).
        robot: Robot model: panda, or panda_camera with HandoverSim's depth camera on its hand, which collides too.
        renderer: Renderer of the wrist camera: bullet, rays, or auto (bullet in exact physics, else rays).
        camera_model: Projection of the wrist camera's point clouds: handoversim (shifted by one pixel, as in the
            original) or pinhole.
        camera_noise: Noise and latency of the wrist camera: default none, realsense, or in Python a `CameraNoise`.
        world_config: World and rules; published results exist only for the default.
    """

    setup: str | None = None
    split: str = "test"
    scenes: Iterable[int] | None = None
    dataset: str = "auto"
    data_dir: str | os.PathLike[str] | None = None
    physics: str = "exact"
    robot: str = PANDA
    renderer: str = "auto"
    camera_model: str = HANDOVERSIM_MODEL
    camera_noise: str | CameraNoise | None = None
    world_config: WorldConfig = OFFICIAL_CONFIG

    def __post_init__(self) -> None:
        # Iterators can be read only once. Other types are reported by `choose_scenes`, where the split is known.
        if isinstance(self.scenes, Iterable):
            object.__setattr__(self, "scenes", tuple(self.scenes))

    @property
    def wrist_camera(self) -> WristCameraConfig:
        """Configuration of the wrist camera.

        Raises:
            UnknownNameError, OptionError: Unknown camera model or noise.
        """
        return WristCameraConfig(self.renderer, self.camera_model, self.camera_noise)
