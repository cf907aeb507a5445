"""Camera observations of many episodes at once, as tensors on a device."""

import numpy as np

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.episode.camera_observations import (
    CLOUDS,
    N_POINTS,
    SensorConfig,
    camera_observation_space,
    count_clouds,
)
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import IMAGES, POINT_MAP, parse_obs_mode
from handover_marl.geometry.arrays import AnyArray, ArrayFactory
from handover_marl.simulation.camera.optics import deproject_pixels, make_pinhole
from handover_marl.simulation.world import WorldState

# Number of episodes whose images are in memory at a time: the images of an episode take about 1 MB.
_CHUNK = 64


class WarpSensors:
    """Noise-free cameras of n episodes; images are rendered by ray casting with Warp.

    Observations equal those of `CameraSensor` with the renderer "rays" to single precision. Only the random subsets of
    clouds with more than 1024 points differ.

    Args:
        obs_mode: Observation mode of the receiver, with point clouds or images.
        sensors: Configuration of the cameras.
        config: Poses of robot and table.
        count: Number n of episodes.
        arrays: Creator of tensors on the device.
    """

    def __init__(
        self, obs_mode: str, sensors: SensorConfig, config: PhysicsConfig, count: int, arrays: ArrayFactory
    ) -> None:
        # Imported here: ray casting on a device needs an extra.
        from handover_marl.simulation.camera.warp_camera import WarpCamera

        self._parts, self._n_clouds = parse_obs_mode(obs_mode), count_clouds(obs_mode)
        self._model, self._arrays, self._cameras = sensors.camera_model, arrays, sensors.cameras
        # Shape and number type of each value.
        space = camera_observation_space(obs_mode, self._cameras)
        self._formats = {key: (own.shape or (), str(own.dtype)) for key, own in space.items()}
        self._camera = WarpCamera(config, count, arrays)
        self._seeds = arrays.zeros(count, "int64")

    def reset(self, row: int, assets: SceneAssets, seed: int) -> None:
        """Prepare the cameras for the episode with index `row`.

        Args:
            row: Index of the episode.
            assets: Models of robot, hand and objects in the scene.
            seed: Seed of the subsampling of point clouds, 32 bits.
        """
        self._camera.load_scene(row, assets)
        self._seeds[row] = seed

    def observe(self, rows: AnyArray, state: Observation, steps: AnyArray) -> Observation:
        """Return the camera data of r episodes: arrays (r, ...) by the keys of `camera_observation_space`.

        Args:
            rows: Indices (r,) of the episodes.
            state: Full state (r, ...) of these episodes.
            steps: Numbers (r,) of physics steps since the start of each episode, which seed the choice of points.
        """
        count = len(rows)
        observation = {key: self._arrays.zeros((count, *shape), dtype) for key, (shape, dtype) in self._formats.items()}
        for first in range(0, count, _CHUNK):
            chunk = slice(first, first + _CHUNK)
            states = WorldState(*(state[key][chunk] for key in WorldState._fields))
            found: Observation = {}
            for camera in self._cameras:
                if self._n_clouds:
                    found |= self._observe_clouds(rows[chunk], states, steps[chunk], camera)
                if self._parts & {*IMAGES, POINT_MAP}:
                    found |= self._observe_images(rows[chunk], states, camera)
            for key in self._formats:
                observation[key][chunk] = found[key].reshape(-1, *self._formats[key][0])
        return observation

    def close(self) -> None:
        """Free the device memory of the models' meshes."""
        self._camera.close()

    def _observe_images(self, rows: AnyArray, states: WorldState, camera: CameraConfig) -> Observation:
        pinhole = make_pinhole(camera)
        images = self._camera.render(rows, states, True, pinhole)
        found = {f"{camera.name}_{key}": getattr(images, key) for key in IMAGES}
        if POINT_MAP in self._parts:
            pixels = self._arrays.asarray(np.arange(pinhole.n_pixels))
            found[f"{camera.name}_{POINT_MAP}"] = deproject_pixels(pixels, images.depth, self._model, pinhole)
        return found

    def _observe_clouds(self, rows: AnyArray, states: WorldState, steps: AnyArray, camera: CameraConfig) -> Observation:
        xp, clouds, counts, pinhole = self._arrays.xp, {}, [], make_pinhole(camera)
        images = self._camera.render(rows, states, False, pinhole, [label for _, label, _ in CLOUDS[: self._n_clouds]])
        for key, label, stream_id in CLOUDS[: self._n_clouds]:
            counts.append(xp.sum(images.segmentation == int(label), axis=1))
            pixels = self._camera.sample_pixels(images, label, N_POINTS, self._seeds[rows], steps, stream_id)
            is_point = pixels < pinhole.n_pixels
            known_pixels = xp.where(is_point, pixels, 0)
            depth = xp.take_along_dim(images.depth, known_pixels, dim=1)
            points = deproject_pixels(known_pixels, depth, self._model, pinhole)
            clouds[f"{camera.name}_{key}"] = xp.where(is_point[..., None], points, 0.0)
        return {**clouds, f"{camera.name}_point_counts": xp.stack(counts, axis=1)}
