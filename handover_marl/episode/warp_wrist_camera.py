"""Wrist-camera observations of many episodes at once, as tensors on a device."""

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.episode.camera_observations import (
    CLOUDS,
    N_POINTS,
    WristCameraConfig,
    camera_observation_space,
    count_clouds,
)
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import IMAGES, SCENE_POINTCLOUD, parse_obs_mode
from handover_marl.geometry.arrays import AnyArray, ArrayFactory
from handover_marl.simulation.camera.optics import N_PIXELS, compute_points
from handover_marl.simulation.world import WorldState

# Episodes whose images are in memory at a time: each takes about 1 MB.
_CHUNK = 64


class WarpWristCamera:
    """Wrist cameras of n episodes without noise; images are rendered by ray casting with Warp.

    Observations equal those of `WristCamera` with the renderer "rays" to single precision, except that the random
    subset is another one for clouds of more than 1024 points.

    Args:
        obs_mode: Observation mode of the receiver, with point clouds or images.
        camera: Configuration of the cameras.
        config: Poses of robot and table.
        count: Number n of episodes.
        arrays: Creator of tensors on the device.
    """

    def __init__(
        self, obs_mode: str, camera: WristCameraConfig, config: PhysicsConfig, count: int, arrays: ArrayFactory
    ) -> None:
        # Imported here: ray casting on a device needs an extra.
        from handover_marl.simulation.camera.warp_camera import WarpCamera

        self._parts, self._n_clouds = parse_obs_mode(obs_mode), count_clouds(obs_mode)
        self._model, self._arrays = camera.camera_model, arrays
        # Shape and number type of each value.
        self._formats = {
            key: (space.shape or (), str(space.dtype)) for key, space in camera_observation_space(obs_mode).items()
        }
        self._camera = WarpCamera(config, count, arrays)
        self._seeds = arrays.zeros(count, "int64")

    def reset(self, row: int, assets: SceneAssets, seed: int) -> None:
        """Prepare the camera of an episode.

        Args:
            row: Index of the episode.
            assets: Models of the scene.
            seed: Seed of the subsampling of point clouds, 32 bits.
        """
        self._camera.load_scene(row, assets)
        self._seeds[row] = seed

    def observe(self, rows: AnyArray, state: Observation, steps: AnyArray) -> Observation:
        """Return the camera data of r episodes; see `camera_observation_space`.

        Args:
            rows: Indices (r,) of the episodes.
            state: Full state (r, ...) of these episodes.
            steps: Physics steps (r,) since the start of each episode, which seed the random choice of points.
        """
        count = len(rows)
        observation = {key: self._arrays.zeros((count, *shape), dtype) for key, (shape, dtype) in self._formats.items()}
        for first in range(0, count, _CHUNK):
            chunk = slice(first, first + _CHUNK)
            states = WorldState(*(state[key][chunk] for key in WorldState._fields))
            found: Observation = {}
            if self._n_clouds:
                found |= self._observe_clouds(rows[chunk], states, steps[chunk])
            if self._parts & IMAGES:
                found |= self._observe_images(rows[chunk], states)
            for key in self._formats:
                observation[key][chunk] = found[key].reshape(-1, *self._formats[key][0])
        return observation

    def close(self) -> None:
        """Free the memory of the device that the meshes of the models take."""
        self._camera.close()

    def _observe_images(self, rows: AnyArray, states: WorldState) -> Observation:
        images = self._camera.render_wrist_camera(rows, states, color=True)
        return {"wrist_depth": images.depth, "wrist_segmentation": images.segmentation, "wrist_rgb": images.rgb}

    def _observe_clouds(self, rows: AnyArray, states: WorldState, steps: AnyArray) -> Observation:
        xp, clouds, counts = self._arrays.xp, {}, []
        images = self._camera.render_targets(rows, states, with_others=SCENE_POINTCLOUD in self._parts)
        for key, label, stream in CLOUDS[: self._n_clouds]:
            counts.append(xp.sum(images.segmentation == int(label), axis=1))
            pixels = self._camera.sample_pixels(images, label, N_POINTS, self._seeds[rows], steps, stream)
            is_point = pixels < N_PIXELS
            known_pixels = xp.where(is_point, pixels, 0)
            points = compute_points(known_pixels, xp.take_along_dim(images.depth, known_pixels, dim=1), self._model)
            clouds[key] = xp.where(is_point[..., None], points, 0.0)
        return {**clouds, "wrist_point_counts": xp.stack(counts, axis=1)}
