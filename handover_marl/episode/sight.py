"""What the robot's wrist camera shows in an episode, as observations and as a view to look at."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import ARM_JOINTS, PANDA_DOF, TIME_STEP, PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import ResetNeededError, UnknownNameError
from handover_marl.models.arm import Arm
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.sim.camera.imperfections import CameraImperfections, imperfections, worsened
from handover_marl.sim.camera.optics import REFERENCE, SIDE, check_geometry, deproject
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.renderers import Renderer, chosen_renderer, make_renderer
from handover_marl.sim.world import Snapshot, World

#: What an agent may be shown: clouds of object and hand, thinned or whole, or pictures.
POINTS, IMAGES, CLOUDS = "points", "images", "clouds"
SIGHTS = (POINTS, IMAGES, CLOUDS)
#: Rows of a cloud in an observation.
N_POINTS = 1024

# What is drawn at random at a moment: which points of either cloud, and noise.
_NOISE = 2


def check_sight(sight: str | None) -> None:
    """Check the name of a kind of sight; None is none.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if sight is not None and sight not in SIGHTS:
        raise UnknownNameError("sight", sight, SIGHTS)


def sight_space(sight: str | None) -> dict[str, spaces.Space[Any]]:
    """What a kind of sight adds to the receiver's observations.

    | sight | key | shape | meaning |
    |---|---|---|---|
    | points | wrist_object_points | (1024, 3) float32 | what is seen of the object to be given, hand link's frame, m |
    | points | wrist_hand_points | (1024, 3) float32 | what is seen of the human hand, likewise |
    | points | wrist_point_counts | (2,) float32 | pixels that show object and hand |
    | images | wrist_depth | (224, 224, 1) float32 | depth along the viewing axis, m |
    | images | wrist_segmentation | (224, 224, 1) uint8 | values of `Seen` |
    | images | wrist_rgb | (224, 224, 3) uint8 | colours |
    | clouds | wrist_object_cloud | (50176, 3) float32 | all that is seen of the object, row by row of the picture |
    | clouds | wrist_hand_cloud | (50176, 3) float32 | all that is seen of the human hand, likewise |
    | clouds | wrist_point_counts | (2,) float32 | as above |
    | clouds | robot_joint_position_exact | (9,) float64 | the robot's joints before they are rounded to float32 |

    Of more than 1024 points as many are drawn without replacement; behind fewer come zeros, in whole clouds too.
    Pictures that arrive late are as they were taken; their points are in the hand link's frame of now all the same.
    "clouds" is for methods that choose points themselves and go on from the engine's own numbers, as HandoverSim's
    scripts for GA-DDPG do.

    Raises:
        UnknownNameError: There is no such sight.
    """
    check_sight(sight)
    counts = spaces.Box(0.0, float(SIDE * SIDE), (2,), np.float32)
    if sight == POINTS:
        cloud = spaces.Box(-np.inf, np.inf, (N_POINTS, 3), np.float32)
        return {"wrist_object_points": cloud, "wrist_hand_points": cloud, "wrist_point_counts": counts}
    if sight == CLOUDS:
        whole = spaces.Box(-np.inf, np.inf, (SIDE * SIDE, 3), np.float32)
        joints = spaces.Box(-np.inf, np.inf, (PANDA_DOF,), np.float64)
        return {
            "wrist_object_cloud": whole,
            "wrist_hand_cloud": whole,
            "wrist_point_counts": counts,
            "robot_joint_position_exact": joints,
        }
    if sight == IMAGES:
        return {
            "wrist_depth": spaces.Box(0.0, np.inf, (SIDE, SIDE, 1), np.float32),
            "wrist_segmentation": spaces.Box(0, int(max(Seen)), (SIDE, SIDE, 1), np.uint8),
            "wrist_rgb": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8),
        }
    return {}


@dataclass(frozen=True)
class SightConfig:
    """How the wrist camera's pictures are made.

    Attributes:
        renderer: "bullet", "rays", or "auto": bullet in exact physics and rays in others.
        geometry: "reference" puts points where HandoverSim puts them, one pixel too far up; "true" where they are.
        imperfections: What is wrong with the camera: None for a perfect one, "realsense", or `CameraImperfections`.

    Raises:
        UnknownNameError: There is no such geometry or camera.
        OptionError: The imperfections are of the wrong type.
    """

    renderer: str = "auto"
    geometry: str = REFERENCE
    imperfections: str | CameraImperfections | None = None

    def __post_init__(self) -> None:
        check_geometry(self.geometry)
        imperfections(self.imperfections)

    @property
    def camera(self) -> CameraImperfections | None:
        """The imperfections themselves."""
        return imperfections(self.imperfections)

    def described(self, sight: str | None, observes: str, physics: str) -> str:
        """What results with a kind of sight are labelled with; empty for who does not look."""
        if sight is None:
            return ""
        told = [
            f"sees {sight}{' alone' if observes == 'sight' else ' and poses'}",
            chosen_renderer(self.renderer, physics),
            f"{self.geometry} geometry",
        ]
        return ", ".join(told if self.camera is None else [*told, repr(self.camera)])


#: How the benchmark draws.
BENCHMARK_SIGHT = SightConfig()


@dataclass(frozen=True, eq=False)
class View:
    """What the wrist camera shows at one moment; points in the frame of the Panda's hand link, row by row.

    A late camera shows an earlier moment, of which the points are in the frame of now.

    Attributes:
        depth: (224, 224) float32 along the viewing axis (m), just under 2 m where nothing is.
        segmentation: (224, 224) uint8, values of `Seen`.
        rgb: (224, 224, 3) uint8.
        object_points: (n, 3) float32 of the object to be given (m).
        hand_points: (m, 3) float32 of the human hand (m).
    """

    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8]
    object_points: npt.NDArray[np.float32]
    hand_points: npt.NDArray[np.float32]


class Sight:
    """The wrist camera in the episodes of one world. Draws only what is asked for, and that once a moment.

    What is drawn at random depends on the seed and on how many steps were simulated, not on who looked before.

    Args:
        config: How pictures are made.
        physics: Kind of physics.
        world: Where robot and table stand.

    Raises:
        UnknownNameError: There is no such renderer. Whether what it needs is installed shows at the first look.
    """

    def __init__(self, config: SightConfig, physics: str, world: PhysicsConfig) -> None:
        chosen_renderer(config.renderer, physics, installed=False)
        self._config, self._physics, self._world_config = config, physics, world
        camera = config.camera
        self._delay = 0 if camera is None else round(camera.latency / TIME_STEP)
        self._seed = 0
        self._scene: Scene | None = None
        self._renderer: Renderer | None = None
        self._past: deque[Snapshot] = deque(maxlen=self._delay + 1)
        self._taken: dict[bool, tuple[int, Photo]] = {}

    @property
    def remembers(self) -> bool:
        """Whether every step must be noted, because pictures arrive late."""
        return self._delay > 0

    def reset(self, scene: Scene, world: World) -> None:
        """Be at the start of a scene."""
        if scene is not self._scene:
            self._renderer = None
        self._scene = scene
        self._taken.clear()
        self._past.clear()
        if self.remembers:
            self.note(world)

    def seed(self, seed: int) -> None:
        """Say what random draws depend on; 0 until then."""
        self._seed = seed
        self._taken.clear()

    def note(self, world: World) -> None:
        """Note where everything is."""
        self._past.append(world.snapshot())

    def look(self, world: World, steps: int) -> View:
        """The view of now: what arrives from the camera after so many steps."""
        photo = self._photo(world, steps, whole=True)
        return View(
            photo.depth.copy(),
            photo.segmentation.copy(),
            # Whole photos have colours.
            np.array(photo.rgb, dtype=np.uint8),
            *self._clouds(photo, world),
        )

    def observe(self, sight: str | None, world: World, steps: int) -> dict[str, npt.NDArray[Any]]:
        """What a kind of sight adds to an observation; see `sight_space`."""
        if sight is None:
            return {}
        if sight == IMAGES:
            view = self.look(world, steps)
            return {
                "wrist_depth": view.depth[..., None],
                "wrist_segmentation": view.segmentation[..., None],
                "wrist_rgb": view.rgb,
            }
        photo = self._photo(world, steps, whole=False)
        clouds = self._clouds(photo, world)
        counts = np.array([len(cloud) for cloud in clouds], dtype=np.float32)
        if sight == CLOUDS:
            return {
                "wrist_object_cloud": _filled(clouds[0], SIDE * SIDE),
                "wrist_hand_cloud": _filled(clouds[1], SIDE * SIDE),
                "wrist_point_counts": counts,
                "robot_joint_position_exact": world.exact_joints(),
            }
        item, hand = (self._thinned(cloud, steps, number) for number, cloud in enumerate(clouds))
        return {"wrist_object_points": item, "wrist_hand_points": hand, "wrist_point_counts": counts}

    def _clouds(self, photo: Photo, world: World) -> list[npt.NDArray[np.float32]]:
        """What is seen of object and hand, in the hand link's frame of now: robots know where their arm was when."""
        clouds = [deproject(photo.depth, photo.shows(seen), self._config.geometry) for seen in (Seen.TARGET, Seen.HAND)]
        if not self.remembers or self._scene is None:
            return clouds
        then, now = self._past[0].robot[:ARM_JOINTS], world.postures().robot[:ARM_JOINTS]
        if np.array_equal(then, now):
            return clouds
        chain = Arm(read_tree(self._scene.assets.panda)).chain(np.array([then, now], dtype=np.float64))
        (before, after), (turned, turns) = chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0)
        return [((cloud @ turned.T + before - after) @ turns).astype(np.float32) for cloud in clouds]

    def _photo(self, world: World, steps: int, whole: bool) -> Photo:
        """What arrives now, drawn if it was not yet; a whole picture serves for what is sought, too."""
        for kind in (True,) if whole else (False, True):
            taken = self._taken.get(kind)
            if taken is not None and taken[0] == steps:
                return taken[1]
        renderer, at = self._ready(), self._past[0] if self.remembers else None
        camera = self._config.camera
        # Edges are those of whole pictures.
        if whole or camera is not None:
            photo = renderer.photograph(world, at, color=whole)
        else:
            photo = renderer.sought(world, at)
        if camera is not None:
            photo = worsened(photo, camera, self._rng(steps, _NOISE))
        self._taken[whole] = (steps, photo)
        return photo

    def _ready(self) -> Renderer:
        if self._renderer is None:
            if self._scene is None:
                raise ResetNeededError("no scene is being played; call reset() first")
            name = chosen_renderer(self._config.renderer, self._physics)
            self._renderer = make_renderer(name, self._scene, self._world_config)
        return self._renderer

    def _thinned(self, cloud: npt.NDArray[np.float32], steps: int, number: int) -> npt.NDArray[np.float32]:
        """(1024, 3) of a cloud (n, 3): as many drawn without replacement, in their order, or all and zeros."""
        if len(cloud) > N_POINTS:
            chosen = self._rng(steps, number).choice(len(cloud), N_POINTS, replace=False)
            return cloud[np.sort(chosen)]
        return _filled(cloud, N_POINTS)

    def _rng(self, steps: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng((self._seed, steps, purpose))


def _filled(cloud: npt.NDArray[np.float32], rows: int) -> npt.NDArray[np.float32]:
    """(rows, 3): a cloud (n, 3) and zeros behind it."""
    filled = np.zeros((rows, 3), dtype=np.float32)
    filled[: len(cloud)] = cloud
    return filled
