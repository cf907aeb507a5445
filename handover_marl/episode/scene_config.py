"""Configuration of scenes and simulation, for environments and for evaluations."""

import os
from collections.abc import Iterable
from dataclasses import dataclass

from handover_marl.config import OFFICIAL_CONFIG, CameraConfig, WorldConfig
from handover_marl.episode.camera_observations import WRIST_ONLY, SensorConfig, resolve_cameras
from handover_marl.geometry.panda import PANDA
from handover_marl.simulation.camera.noise import CameraNoise
from handover_marl.simulation.camera.optics import HANDOVERSIM_MODEL
from handover_marl.simulation.camera.randomization import CALIBRATION_ERRORS, CameraRandomization


@dataclass(frozen=True)
class SceneConfig:
    """Configuration of scenes and simulation.

    Attributes:
        setup: Official setup: s0 no unseen factor, s1 unseen subjects, s2 unseen handedness, s3 unseen objects; or a
            setup of other data. Default: the first of the dataset, s0 of the official ones.
        split: Split of the setup: train, val or test.
        scenes: Scene numbers of the split, e.g. 209,214; default: all. Reports say if scenes are left out.
        dataset: Dataset: dexycb, synthetic, generated:n=1000,seed=7 (any number of scenes), own:FOLDER (custom scenes),
            or auto (dexycb if a data folder is found, else synthetic).
        data_dir: Data folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        physics: Physics: exact (official results), fast (an object is simulated only after the robot has come near
            it, or after the release), or mujoco (another engine).
        robot: Robot model: panda, or panda_camera (with HandoverSim's wrist camera, whose housing can collide).
        renderer: Renderer of the cameras: bullet, rays, or auto (bullet in exact physics, else rays).
        camera_model: Projection of the cameras' point clouds: handoversim (shifted by one pixel, as in the
            original) or pinhole.
        camera_noise: Noise and latency of the cameras: realsense; imperfect, with more latency and calibration errors;
            a part of imperfect (depth_noise, latency, hand_eye, intrinsics); in Python a `CameraNoise`; default: none.
        cameras: Cameras of the observations, each a name (wrist, front, over_shoulder) or in Python a `CameraConfig`.
        camera_randomization: Random deviations of the cameras from their configuration, in Python a
            `CameraRandomization`, in addition to the calibration errors of `camera_noise`; default: none.
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
    cameras: Iterable[str | CameraConfig] = WRIST_ONLY
    camera_randomization: CameraRandomization | None = None
    world_config: WorldConfig = OFFICIAL_CONFIG

    def __post_init__(self) -> None:
        # Iterators can be read only once. Other types are reported by `choose_scenes`, where the split is known.
        if isinstance(self.scenes, Iterable):
            object.__setattr__(self, "scenes", tuple(self.scenes))
        if isinstance(self.cameras, Iterable) and not isinstance(self.cameras, str):
            object.__setattr__(self, "cameras", tuple(self.cameras))

    @property
    def sensors(self) -> SensorConfig:
        """Configuration of the cameras; raises `UnknownNameError` or `OptionError` if a field has a wrong value."""
        randomization = self.camera_randomization
        errors = CALIBRATION_ERRORS.get(self.camera_noise) if isinstance(self.camera_noise, str) else None
        if randomization is None or errors is None:
            randomization = randomization or errors
        else:
            randomization = randomization.combine(errors)
        cameras = resolve_cameras(self.cameras)
        return SensorConfig(self.renderer, self.camera_model, self.camera_noise, cameras, randomization)
