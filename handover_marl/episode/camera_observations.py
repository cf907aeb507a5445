"""Cameras of the receiver: their configuration, images and point clouds, and the observations made of them."""

import hashlib
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import ARM_DOF, CAMERAS, PANDA_DOF, TIME_STEP, CameraConfig, PhysicsConfig, check_config
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.spaces import (
    DEPTH,
    FULL_POINTCLOUD,
    IMAGES,
    POINT_MAP,
    POINTCLOUD,
    RGB,
    SCENE_POINTCLOUD,
    SEGMENTATION,
    has_camera,
    parse_obs_mode,
)
from handover_marl.errors import OptionError, ResetNeededError, check_name
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import MOUNT_LINKS
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.noise import CameraNoise, apply_camera_noise, resolve_camera_noise
from handover_marl.simulation.camera.optics import CAMERA_MODELS, HANDOVERSIM_MODEL, Pinhole, deproject, make_pinhole
from handover_marl.simulation.camera.randomization import CameraDraw, CameraRandomization
from handover_marl.simulation.camera.renderers import BULLET, RENDERERS, resolve_renderer
from handover_marl.simulation.world import World

if TYPE_CHECKING:
    from handover_marl.simulation.camera.ray_camera import RayCamera

Cloud = npt.NDArray[np.float32]

#: Number of points of a subsampled cloud in an observation.
N_POINTS = 1024

#: Clouds of an observation: end of the key, segmentation label, and number of the random stream for subsampling.
CLOUDS = (
    ("object_points", SegmentationLabel.TARGET, 0),
    ("hand_points", SegmentationLabel.HAND, 1),
    ("other_points", SegmentationLabel.OTHER_OBJECT, 3),
)
#: Names of the cameras of an observation by default.
WRIST_ONLY = ("wrist",)
_NOISE_STREAM = 2


class _ImageContent(IntEnum):
    """Content of an image: target object and hand; all objects and hand; all bodies; all bodies with colors."""

    TARGETS = 0
    OBJECTS = 1
    WHOLE = 2
    COLORED = 3


def camera_observation_space(
    obs_mode: str, cameras: Iterable[str | CameraConfig] = WRIST_ONLY
) -> dict[str, spaces.Space[Any]]:
    """Return the spaces of the camera data that an observation mode includes, by key.

    docs/reference/environment.md lists the keys of the camera "wrist"; keys of another camera start with its name.
    Points are in the frame of the link that carries the camera, or in the world frame without a link. Clouds of more
    than 1024 points are subsampled without replacement, shorter ones padded with zeros; full clouds are padded to the
    number of pixels. A camera with latency shows earlier images; their points are in the link's current frame.
    "full_pointcloud" is for methods that subsample the points themselves and need the robot's joint positions in
    float64, such as HandoverSim's scripts for GA-DDPG.
    """
    found = dict[str, spaces.Space[Any]]()
    for camera in resolve_cameras(cameras):
        found |= _make_spaces(obs_mode, camera)
    return found


def _make_spaces(obs_mode: str, camera: CameraConfig) -> dict[str, spaces.Space[Any]]:
    parts, count, found = parse_obs_mode(obs_mode), count_clouds(obs_mode), dict[str, spaces.Space[Any]]()
    shape, n_pixels = (camera.height, camera.width), camera.height * camera.width
    cloud, whole = (spaces.Box(-np.inf, np.inf, (size, 3), np.float32) for size in (N_POINTS, n_pixels))
    if parts & {POINTCLOUD, SCENE_POINTCLOUD}:
        found |= {f"{camera.name}_{key}": cloud for key, *_ in CLOUDS[:count]}
    if FULL_POINTCLOUD in parts:
        found |= {f"{camera.name}_object_cloud": whole, f"{camera.name}_hand_cloud": whole}
    if count:
        found[f"{camera.name}_point_counts"] = spaces.Box(0.0, float(n_pixels), (count,), np.float32)
    if FULL_POINTCLOUD in parts:
        found["robot_joint_position_exact"] = spaces.Box(-np.inf, np.inf, (PANDA_DOF,), np.float64)
    images: dict[str, spaces.Space[Any]] = {
        DEPTH: spaces.Box(0.0, np.inf, (*shape, 1), np.float32),
        SEGMENTATION: spaces.Box(0, int(max(SegmentationLabel)), (*shape, 1), np.uint8),
        RGB: spaces.Box(0, 255, (*shape, 3), np.uint8),
        POINT_MAP: spaces.Box(-np.inf, np.inf, (*shape, 3), np.float32),
    }
    return found | {f"{camera.name}_{name}": space for name, space in images.items() if name in parts}


def resolve_cameras(cameras: Iterable[str | CameraConfig]) -> tuple[CameraConfig, ...]:
    """Return the configurations of cameras, given as names or configurations; raise `OptionError` if names repeat."""
    if isinstance(cameras, str) or not isinstance(cameras, Iterable):
        raise OptionError(
            f'cameras must be a tuple of names and CameraConfigs, got {cameras!r}; e.g. ("wrist", "front")'
        )
    found = []
    for camera in cameras:
        if isinstance(camera, str):
            check_name("camera", camera, CAMERAS)
            camera = CAMERAS[camera]
        check_config("every camera", camera, CameraConfig)
        found.append(camera)
    names = [camera.name for camera in found]
    if len(set(names)) < len(names):
        raise OptionError(f"cameras must have different names, got {', '.join(names)}; set CameraConfig.name")
    return tuple(found)


def count_clouds(obs_mode: str) -> int:
    """Return the number of point clouds in an observation mode: 0, 2 (object, hand) or 3 (also other objects)."""
    parts = parse_obs_mode(obs_mode)
    return 3 if SCENE_POINTCLOUD in parts else 2 if parts & {POINTCLOUD, FULL_POINTCLOUD} else 0


@dataclass(frozen=True)
class SensorConfig:
    """Configuration of the receiver's cameras.

    Attributes:
        renderer: "bullet" (PyBullet), "rays" (ray casting), or "auto": bullet in exact physics and
            rays in other physics.
        camera_model: Deprojection: "handoversim" repeats HandoverSim's shift by one pixel, "pinhole" is exact.
        camera_noise: Noise of the images: None (no noise), a name of `CAMERA_NOISE_MODELS`, or a `CameraNoise`.
        cameras: Configurations of the cameras; `resolve_cameras` returns them for names.
        randomization: Random deviations of the cameras, drawn in each episode; None for no deviations.
    """

    renderer: str = "auto"
    camera_model: str = HANDOVERSIM_MODEL
    camera_noise: str | CameraNoise | None = None
    cameras: tuple[CameraConfig, ...] = (CAMERAS["wrist"],)
    randomization: CameraRandomization | None = None

    def __post_init__(self) -> None:
        check_name("renderer", self.renderer, RENDERERS)
        check_name("camera_model", self.camera_model, CAMERA_MODELS)
        if self.camera_noise is not None:
            resolve_camera_noise(self.camera_noise)
        if self.randomization is not None:
            check_config("camera_randomization", self.randomization, CameraRandomization)

    @property
    def noise(self) -> CameraNoise | None:
        """Noise model of the cameras; None for perfect images."""
        return resolve_camera_noise(self.camera_noise)

    def describe(self, obs_mode: str, physics: str) -> str:
        """Return text for results: renderer in this physics, camera model, noise, randomization and cameras.

        The text is "" for a mode without camera data, and does not mention the default camera.
        """
        if not has_camera(obs_mode):
            return ""
        parts = [f"renderer {resolve_renderer(self.renderer, physics)}", f"camera model {self.camera_model}"]
        parts += [repr(part) for part in (self.noise, self.randomization) if part is not None]
        return ", ".join(parts if self.cameras == BENCHMARK_SENSORS.cameras else [*parts, *map(repr, self.cameras)])


#: Configuration of the benchmark: the wrist camera without noise.
BENCHMARK_SENSORS = SensorConfig()


@dataclass(frozen=True, eq=False)
class CameraCapture:
    """Images (h x w pixels) and point clouds of the wrist camera at one step.

    A camera with latency shows an earlier step. Points are in the current frame of the link that carries the camera,
    by default the Panda's hand link.

    Attributes:
        depth: (h, w) float32 depth along the viewing axis (m); just under `far`, by default 2 m, for background.
        segmentation: (h, w) uint8 values of `SegmentationLabel`.
        rgb: (h, w, 3) uint8 colors.
        object_points: (n, 3) float32 points of the handed-over object (m), in the order of their pixels.
        hand_points: (m, 3) float32 points of the human hand (m), in the order of their pixels.
    """

    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8]
    object_points: Cloud
    hand_points: Cloud


class CameraSensor:
    """One camera of a simulated world; images are rendered on request and reused within a physics step.

    Noise and subsampling of points depend only on the seed, the number of simulated steps and the image. Random changes
    of the camera depend only on the seed, the objects' poses at the start and the camera's name.

    Args:
        config: Configuration of the cameras.
        physics: Kind of physics, "exact", "fast" or "mujoco".
        physics_config: World configuration, which has the poses of robot and table.
        name: Name of the camera, one of `config.cameras`.

    Attributes:
        has_latency: Whether images are late or periodic; `record_snapshot` must then be called in every physics step.
    """

    def __init__(self, config: SensorConfig, physics: str, physics_config: PhysicsConfig, name: str = "wrist") -> None:
        cameras = {camera.name: camera for camera in config.cameras}
        self._camera_config = cameras[name]
        self._config, self._physics, self._physics_config = config, physics, physics_config
        self._camera, self._randomization = make_pinhole(self._camera_config), config.randomization
        self._period = round(self._camera_config.period / TIME_STEP)
        noise, random = config.noise, config.randomization or CameraRandomization()
        is_late = noise is not None and round(noise.latency / TIME_STEP) > 0
        self.has_latency = is_late or random.latency > 0.0 or self._period > 1
        self._seed = 0
        # Camera of the current episode; None before its first use.
        self._episode_camera: CameraDraw | None = None
        self._scene: Scene | None = None
        self._renderer: str | None = None
        self._ray_camera: RayCamera | None = None
        # Steps and snapshots of the image that is shown and of those that have not arrived.
        self._history: deque[tuple[int, JointSnapshot]] = deque()
        # Last image with its step and content.
        self._last: tuple[int, _ImageContent, CameraImage] | None = None

    def reset(self, scene: Scene, world: World) -> None:
        """Prepare the camera for an episode of a scene; the world must be at the scene's start."""
        if scene is not self._scene:
            self._ray_camera = None
        self._scene = scene
        self._last = self._episode_camera = None
        self._history.clear()
        if self.has_latency:
            self.record_snapshot(world, 0)

    def seed(self, seed: int) -> None:
        """Set the seed (by default 0) of subsampling, noise and randomization."""
        self._seed = seed
        self._last = self._episode_camera = None

    def record_snapshot(self, world: World, steps: int) -> None:
        """Record the joint positions of `world` for an image, if the camera takes one after `steps` physics steps."""
        if steps % max(self._period, 1) == 0:
            self._history.append((steps, world.read_joint_snapshot()))
        noise = self._draw_camera().noise
        delay = 0 if noise is None else round(noise.latency / TIME_STEP)
        while len(self._history) > 1 and self._history[1][0] + delay <= steps:
            self._history.popleft()

    def capture(self, world: World, steps: int) -> CameraCapture:
        """Return the images and point clouds that are available after `steps` physics steps of a world's episode."""
        image = self._get_image(world, steps, _ImageContent.COLORED)
        rgb = np.array(image.rgb, dtype=np.uint8)
        return CameraCapture(image.depth.copy(), image.segmentation.copy(), rgb, *self._compute_clouds(image, world, 2))

    def observe(self, obs_mode: str, world: World, steps: int) -> dict[str, npt.NDArray[Any]]:
        """Return the camera data of a mode, see `camera_observation_space`, after `steps` physics steps of a world."""
        parts, observation, name = parse_obs_mode(obs_mode), dict[str, npt.NDArray[Any]](), self._camera_config.name
        image = self._get_image(world, steps, _select_content(parts))
        clouds = self._compute_clouds(image, world, count_clouds(obs_mode))
        if parts & {POINTCLOUD, SCENE_POINTCLOUD}:
            named = zip(CLOUDS, clouds, strict=False)
            observation |= {f"{name}_{key}": self._subsample(cloud, steps, number) for (key, _, number), cloud in named}
        if FULL_POINTCLOUD in parts:
            observation[f"{name}_object_cloud"], observation[f"{name}_hand_cloud"] = (
                _pad_cloud(cloud, self._camera.n_pixels) for cloud in clouds[:2]
            )
        if clouds:
            observation[f"{name}_point_counts"] = np.array([len(cloud) for cloud in clouds], dtype=np.float32)
        if FULL_POINTCLOUD in parts:
            observation["robot_joint_position_exact"] = world.read_joints_float64()
        if DEPTH in parts:
            observation[f"{name}_depth"] = image.depth[..., None].copy()
        if SEGMENTATION in parts:
            observation[f"{name}_segmentation"] = image.segmentation[..., None].copy()
        if RGB in parts:
            observation[f"{name}_rgb"] = np.array(image.rgb, dtype=np.uint8)
        if POINT_MAP in parts:
            points = self._compute_cloud(image, np.ones(image.depth.shape, dtype=np.bool_), world)
            observation[f"{name}_point_map"] = points.reshape(*image.depth.shape, 3)
        return observation

    def _compute_clouds(self, image: CameraImage, world: World, count: int) -> list[Cloud]:
        """Compute the first `count` point clouds (n, 3) of `CLOUDS` in the frame of the camera's link (m)."""
        return [self._compute_cloud(image, image.compute_mask(label), world) for _, label, _ in CLOUDS[:count]]

    def _compute_cloud(self, image: CameraImage, mask: npt.NDArray[np.bool_], world: World) -> Cloud:
        """Compute the points (n, 3) of the pixels in a mask (h, w) in the frame of the camera's link (m)."""
        link = self._camera.link
        cloud = deproject(image.depth, mask, self._config.camera_model, self._camera)
        if not self.has_latency or self._scene is None or not link:
            return cloud
        # Robots know their joint positions at the time of an image.
        then, now = self._history[0][1].robot[:ARM_DOF], world.read_joint_snapshot().robot[:ARM_DOF]
        if np.array_equal(then, now):
            return cloud
        chain = ArmKinematics(read_tree(self._scene.assets.panda)).compute_chain_frames(
            np.array([then, now], dtype=np.float64)
        )
        number = MOUNT_LINKS.index(link)
        old_origin, origin = chain.origins[number].T
        old_rotation, rotation = np.moveaxis(chain.rotations[number], -1, 0)
        moved: Cloud = ((cloud @ old_rotation.T + old_origin - origin) @ rotation).astype(np.float32)
        return moved

    def _get_image(self, world: World, steps: int, content: _ImageContent) -> CameraImage:
        """Return an image with at least `content` after `steps` physics steps; reuse the last one if it is enough."""
        if self._last is not None and self._last[0] == steps and self._last[1] >= content:
            return self._last[2]
        camera, noise, _ = drawn = self._draw_camera()
        # Noise at edges needs the whole image.
        rendered = content if noise is None else max(content, _ImageContent.WHOLE)
        image = drawn.change_colors(self._render(world, content == _ImageContent.COLORED, rendered, camera))
        if noise is not None:
            # With a period, the noise is that of the image, not of the observation.
            rng = self._make_rng(image.depth, self._history[0][0] if self._period > 1 else steps, _NOISE_STREAM)
            image = apply_camera_noise(image, noise, rng, camera)
        self._last = (steps, content, image)
        return image

    def _draw_camera(self) -> CameraDraw:
        """Return the camera of the current episode, with deviations drawn at random for this episode if configured.

        The random numbers depend on the seed, the camera's name and the objects' poses at the start. If they depended
        on the scene's number, receivers could find out this number from the deviations.
        """
        if self._episode_camera is None:
            self._episode_camera = CameraDraw(self._camera, self._config.noise, None)
            if self._randomization is not None and self._scene is not None:
                content = self._camera_config.name.encode() + self._scene.object_dof[0].tobytes()
                rng = np.random.default_rng((self._seed, int.from_bytes(hashlib.sha256(content).digest()[:8], "big")))
                self._episode_camera = self._randomization.draw(self._camera, self._config.noise, rng)
        return self._episode_camera

    def _render(self, world: World, color: bool, content: _ImageContent, camera: Pinhole) -> CameraImage:
        if self._scene is None:
            raise ResetNeededError("the episode has not started; call reset() first")
        if self._renderer is None:
            self._renderer = resolve_renderer(self._config.renderer, self._physics)
        earlier = self._history[0][1] if self.has_latency else None
        if self._renderer == BULLET:
            return world.render_camera(earlier, color, camera)
        if self._ray_camera is None:
            # Imported here: ray casting needs an extra.
            from handover_marl.simulation.camera.ray_camera import RayCamera

            self._ray_camera = RayCamera(self._scene.assets, self._physics_config)
        snapshot = earlier or world.read_joint_snapshot()
        if content >= _ImageContent.WHOLE:
            return self._ray_camera.render(snapshot, color, camera)
        return self._ray_camera.render_targets(snapshot, content == _ImageContent.OBJECTS, camera)

    def _subsample(self, cloud: Cloud, steps: int, stream_id: int) -> Cloud:
        """Return a cloud (n, 3) with 1024 points: a random subset in the order of pixels, or all points, then zeros."""
        if len(cloud) > N_POINTS:
            chosen = self._make_rng(cloud, steps, stream_id).choice(len(cloud), N_POINTS, replace=False)
            return cloud[np.sort(chosen)]
        return _pad_cloud(cloud, N_POINTS)

    def _make_rng(self, content: npt.NDArray[np.float32], steps: int, stream_id: int) -> np.random.Generator:
        """Return a random generator, seeded by the camera's seed, `steps`, `stream_id` and the bytes of `content`."""
        digest = hashlib.sha256(content.tobytes()).digest()
        return np.random.default_rng((self._seed, steps, stream_id, int.from_bytes(digest[:8], "big")))


def _select_content(parts: frozenset[str]) -> _ImageContent:
    """Return which bodies an image must show for the parts of an observation mode, and whether in colors."""
    if RGB in parts:
        return _ImageContent.COLORED
    if parts & {*IMAGES, POINT_MAP}:
        return _ImageContent.WHOLE
    return _ImageContent.OBJECTS if SCENE_POINTCLOUD in parts else _ImageContent.TARGETS


def _pad_cloud(cloud: Cloud, rows: int) -> Cloud:
    """Return a cloud (n, 3) with zeros appended, float32 (rows, 3)."""
    padded = np.zeros((rows, 3), dtype=np.float32)
    padded[: len(cloud)] = cloud
    return padded
