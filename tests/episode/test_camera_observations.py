"""Tests of camera observations, which do not depend on earlier images and are rendered on request only."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces

from handover_marl.config import OFFICIAL_CONFIG, PandaConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.camera_observations import (
    CameraCapture,
    CameraSensor,
    SensorConfig,
    camera_observation_space,
)
from handover_marl.episode.episode import Episode
from handover_marl.episode.spaces import FULL_POINTCLOUD, OBS_PARTS, POINTCLOUD, SCENE_POINTCLOUD, STATE
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.noise import CameraNoise
from handover_marl.simulation.camera.optics import HANDOVERSIM_MODEL, PINHOLE_MODEL, deproject
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.world import World
from tests.helpers.equality import assert_equal

Observation = dict[str, npt.NDArray[Any]]

DATA = open_dataset("synthetic", robot="panda_camera")
SCENE, OTHER = DATA.load_scene(9), DATA.load_scene(14)
GOAL = np.array(PandaConfig().start_joints, dtype=np.float32)
GOAL[:7] += [0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2]
#: Step at which more than 1024 pixels show the object, and some the hand.
STEPS = 2000
OBJECT, HAND, COUNTS = "wrist_object_points", "wrist_hand_points", "wrist_point_counts"
PERFECT = CameraNoise(depth_noise_std=0.0, edge_dropout=0.0, latency=0.0)
NOISY = CameraNoise(latency=0.0)


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    """Yield the world of a scene after `STEPS` steps; rendering does not change it."""
    episode = Episode("fast")
    episode.reset(SCENE)
    episode.advance(GOAL, STEPS)
    yield episode.world
    episode.close()


def make_wrist_camera(world: World, seed: int = 0, **options: Any) -> CameraSensor:
    """Return a seeded camera that has been reset as at the start of an episode."""
    wrist_camera = CameraSensor(SensorConfig(**{"renderer": "rays", **options}), "fast", OFFICIAL_CONFIG.physics)
    wrist_camera.reset(SCENE, world)
    wrist_camera.seed(seed)
    return wrist_camera


def as_dict(view: CameraCapture) -> Observation:
    return dict(vars(view))


def places_in(rows: npt.NDArray[np.float32], cloud: npt.NDArray[np.float32]) -> list[int]:
    """Return the index of each row in a point cloud without equal points."""
    where = {row.tobytes(): place for place, row in enumerate(cloud)}
    assert len(where) == len(cloud)
    return [where[row.tobytes()] for row in rows]


def test_spaces_are_as_documented() -> None:
    assert camera_observation_space(STATE) == {}
    points, images, clouds = (
        camera_observation_space(mode) for mode in (POINTCLOUD, "rgbd+segmentation", FULL_POINTCLOUD)
    )
    shapes = {key: (space.shape, space.dtype) for key, space in {**points, **images, **clouds}.items()}
    assert list(points) == [OBJECT, HAND, COUNTS]
    assert shapes == {
        OBJECT: ((1024, 3), np.float32),
        HAND: ((1024, 3), np.float32),
        COUNTS: ((2,), np.float32),
        "wrist_depth": ((224, 224, 1), np.float32),
        "wrist_segmentation": ((224, 224, 1), np.uint8),
        "wrist_rgb": ((224, 224, 3), np.uint8),
        "wrist_object_cloud": ((224 * 224, 3), np.float32),
        "wrist_hand_cloud": ((224 * 224, 3), np.float32),
        "robot_joint_position_exact": ((9,), np.float64),
    }
    scene = {key: space.shape for key, space in camera_observation_space(SCENE_POINTCLOUD).items()}
    assert scene == {OBJECT: (1024, 3), HAND: (1024, 3), "wrist_other_points": (1024, 3), COUNTS: (3,)}
    for key, high in ((COUNTS, 224 * 224), ("wrist_segmentation", 5), ("wrist_rgb", 255), ("wrist_depth", np.inf)):
        space = {**points, **images}[key]
        assert isinstance(space, spaces.Box)
        assert (space.low.min(), space.high.max()) == (0, high)


@pytest.mark.slow
@pytest.mark.parametrize("obs_mode", [*OBS_PARTS, "state+rgbd+segmentation+full_pointcloud"])
def test_observations_are_elements_of_their_space(world: World, obs_mode: str) -> None:
    seen = make_wrist_camera(world, camera_noise="realsense").observe(obs_mode, world, STEPS)
    space = spaces.Dict(camera_observation_space(obs_mode))
    assert list(seen) == list(camera_observation_space(obs_mode))
    assert space.contains(seen)
    for key, value in seen.items():
        assert (value.shape, value.dtype) == (space[key].shape, space[key].dtype)


@pytest.mark.slow
def test_a_combination_has_what_its_parts_have(world: World) -> None:
    parts = ("depth", "rgb", SCENE_POINTCLOUD)
    for options in ({}, {"camera_noise": NOISY}):
        seen = make_wrist_camera(world, **options).observe("state+" + "+".join(parts), world, STEPS)
        alone = [make_wrist_camera(world, **options).observe(part, world, STEPS) for part in parts]
        assert_equal(seen, {key: value for observation in alone for key, value in observation.items()})
        assert "wrist_segmentation" not in seen


@pytest.mark.slow
@pytest.mark.parametrize("camera_model", [HANDOVERSIM_MODEL, PINHOLE_MODEL])
def test_clouds_and_images_of_a_frame_agree(world: World, camera_model: str) -> None:
    """Images equal the ray caster's, and points equal those deprojected from depth and segmentation, row by row."""
    view = make_wrist_camera(world, camera_model=camera_model).capture(world, STEPS)
    expected = RayCamera(SCENE.assets, OFFICIAL_CONFIG.physics).render(world.read_joint_snapshot(), color=True)
    np.testing.assert_array_equal(view.depth, expected.depth)
    np.testing.assert_array_equal(view.segmentation, expected.segmentation)
    np.testing.assert_array_equal(view.rgb, expected.rgb)
    for points, seen in ((view.object_points, SegmentationLabel.TARGET), (view.hand_points, SegmentationLabel.HAND)):
        shown = view.segmentation == seen
        assert points.dtype == np.float32
        assert len(points) == shown.sum() > 50
        np.testing.assert_array_equal(points, deproject(view.depth, shown, camera_model))


@pytest.mark.parametrize("camera", [None, NOISY])
def test_clouds_are_subsampled_or_padded(world: World, camera: CameraNoise | None) -> None:
    wrist_camera = make_wrist_camera(world, camera_noise=camera)
    seen, view = wrist_camera.observe(POINTCLOUD, world, STEPS), wrist_camera.capture(world, STEPS)
    assert seen[COUNTS].tolist() == [len(view.object_points), len(view.hand_points)]
    assert seen[COUNTS].tolist() == [
        (view.segmentation == kind).sum() for kind in (SegmentationLabel.TARGET, SegmentationLabel.HAND)
    ]
    places = places_in(seen[OBJECT], view.object_points)
    assert len(view.object_points) > 1100
    assert len(set(places)) == 1024, "without replacement"
    assert places == sorted(places), "in their order"
    # Points are drawn from the whole image, not from its first rows.
    assert places[0] < 30
    assert places[-1] > len(view.object_points) - 30


@pytest.mark.parametrize(("camera", "renderer"), [(None, "bullet"), (NOISY, "rays")])
def test_scene_clouds_have_points_of_other_objects(world: World, camera: CameraNoise | None, renderer: str) -> None:
    options = {"camera_noise": camera, "renderer": renderer}
    seen = make_wrist_camera(world, **options).observe(SCENE_POINTCLOUD, world, STEPS)
    targets = make_wrist_camera(world, **options).observe(POINTCLOUD, world, STEPS)
    for key in (OBJECT, HAND):
        np.testing.assert_array_equal(seen[key], targets[key])
    np.testing.assert_array_equal(seen[COUNTS][:2], targets[COUNTS])
    view = make_wrist_camera(world, **options).capture(world, STEPS)
    cloud = deproject(view.depth, view.segmentation == SegmentationLabel.OTHER_OBJECT)
    count = int(seen[COUNTS][2])
    assert len(cloud) == count > 20
    places = places_in(seen["wrist_other_points"][: min(count, 1024)], cloud)
    assert places == sorted(set(places))


LOOKS: list[Callable[[CameraSensor, World], object]] = [
    lambda wrist_camera, world: None,
    lambda wrist_camera, world: wrist_camera.capture(world, STEPS),
    lambda wrist_camera, world: wrist_camera.observe(POINTCLOUD, world, STEPS),
    lambda wrist_camera, world: wrist_camera.observe("rgbd", world, STEPS),
    lambda wrist_camera, world: wrist_camera.capture(world, STEPS - 1),
    lambda wrist_camera, world: wrist_camera.observe(POINTCLOUD, world, STEPS - 1),
]


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "renderer"), [(None, "rays"), (NOISY, "rays"), (None, "bullet")])
def test_observations_do_not_depend_on_earlier_images(world: World, renderer: str, camera: CameraNoise | None) -> None:
    """Observations are bit-equal after any earlier image, although points alone are rendered differently."""
    expected = make_wrist_camera(world, 3, renderer=renderer, camera_noise=camera)
    points = expected.observe(POINTCLOUD, world, STEPS)
    view = as_dict(expected.capture(world, STEPS))
    for look in LOOKS:
        wrist_camera = make_wrist_camera(world, 3, renderer=renderer, camera_noise=camera)
        look(wrist_camera, world)
        assert_equal(wrist_camera.observe(POINTCLOUD, world, STEPS), points)
        assert_equal(as_dict(wrist_camera.capture(world, STEPS)), view)
        assert_equal(wrist_camera.observe(POINTCLOUD, world, STEPS), points)


@pytest.mark.parametrize("camera", [None, NOISY])
def test_draws_repeat_from_seed_and_step(world: World, camera: CameraNoise | None) -> None:
    def drawn(seed: int, steps: int) -> npt.NDArray[np.float32]:
        return make_wrist_camera(world, seed, camera_noise=camera).observe(POINTCLOUD, world, steps)[OBJECT]

    np.testing.assert_array_equal(drawn(1, STEPS), drawn(1, STEPS))
    for other in (drawn(2, STEPS), drawn(1, STEPS + 1), drawn(STEPS, 1)):
        assert (drawn(1, STEPS) != other).any()
    wrist_camera = make_wrist_camera(world, 0, camera_noise=camera)
    first = wrist_camera.observe(POINTCLOUD, world, STEPS)
    for seed in (1, 2, 1):
        wrist_camera.seed(seed)
        np.testing.assert_array_equal(wrist_camera.observe(POINTCLOUD, world, STEPS)[OBJECT], drawn(seed, STEPS))
    wrist_camera.seed(0)
    assert_equal(wrist_camera.observe(POINTCLOUD, world, STEPS), first)
    unseeded = CameraSensor(SensorConfig(renderer="rays", camera_noise=camera), "fast", OFFICIAL_CONFIG.physics)
    unseeded.reset(SCENE, world)
    assert_equal(unseeded.observe(POINTCLOUD, world, STEPS), first)


def test_arrays_may_be_written_to(world: World) -> None:
    wrist_camera, fresh = (make_wrist_camera(world, camera_noise=NOISY) for _ in range(2))
    for look in (
        lambda of: of.observe(POINTCLOUD, world, STEPS),
        lambda of: of.observe("rgbd", world, STEPS),
        lambda of: as_dict(of.capture(world, STEPS)),
    ):
        seen = look(wrist_camera)
        for value in seen.values():
            value[...] = 7
        assert_equal(look(wrist_camera), look(fresh))
        assert_equal(look(wrist_camera), look(fresh))


def test_a_camera_without_faults_is_perfect(world: World) -> None:
    for renderer in ("rays", "bullet"):
        perfect = make_wrist_camera(world, 1, renderer=renderer)
        flawless = make_wrist_camera(world, 1, renderer=renderer, camera_noise=PERFECT)
        assert not flawless.has_latency
        assert_equal(flawless.observe(POINTCLOUD, world, STEPS), perfect.observe(POINTCLOUD, world, STEPS))
        assert_equal(as_dict(flawless.capture(world, STEPS)), as_dict(perfect.capture(world, STEPS)))


class Diary:
    """Callback that records the images of a camera without noise at the start and at the steps in `wanted`."""

    def __init__(self, episode: Episode, renderer: str, physics: str, scene: Scene) -> None:
        self._sight = CameraSensor(SensorConfig(renderer=renderer), physics, OFFICIAL_CONFIG.physics)
        self._sight.reset(scene, episode.world)
        self.views = {0: self._sight.capture(episode.world, 0)}
        self.links = {0: episode.observe()["gripper_pose"]}
        self.wanted: set[int] = set()

    def __call__(self, episode: Episode) -> None:
        if episode.steps in self.wanted:
            self.views[episode.steps] = self._sight.capture(episode.world, episode.steps)
            self.links[episode.steps] = episode.observe()["gripper_pose"]

    def assert_arrived(self, episode: Episode, step: int) -> None:
        """Assert that the current delayed image is that of `step`, with points at the same positions in the world."""
        arrived, then = as_dict(episode.capture_wrist_camera()), as_dict(self.views[step])
        now = episode.observe()["gripper_pose"]
        for name in ("object_points", "hand_points"):
            seen, was = arrived.pop(name), then.pop(name)
            assert seen.dtype == np.float32
            if (now == self.links[step]).all():
                np.testing.assert_array_equal(seen, was)
            places, before = transform_points(now, seen), transform_points(self.links[step], was)
            np.testing.assert_allclose(places, before, rtol=0.0, atol=5e-6)
        assert_equal(arrived, then)


@pytest.mark.slow
def test_late_images_are_those_of_earlier_steps() -> None:
    delay, chunk, noise = 130, 50, CameraNoise(depth_noise_std=0.0, edge_dropout=0.0, latency=0.13)
    episode = Episode("fast", sensors=SensorConfig(renderer="rays", camera_noise=noise))
    for scene in (SCENE, OTHER):
        # No image of the previous scene must be left.
        episode.reset(scene)
        diary = Diary(episode, "rays", "fast", scene)
        diary.assert_arrived(episode, 0)
        ends = [min(10, delay), delay, delay + 1, 180, 287]
        diary.wanted = {end - delay + more for end in ends for more in (-1, 0, 1)}
        for end in ends:
            while episode.steps < end:
                episode.advance(GOAL, min(chunk, end - episode.steps), on_step=[diary])
            arrived = episode.capture_wrist_camera()
            diary.assert_arrived(episode, max(0, end - delay))
            if end > delay:
                assert (arrived.depth != diary.views[end - delay - 1].depth).any()
            counts = episode.observe_camera(POINTCLOUD)[COUNTS].tolist()
            assert counts == [len(arrived.object_points), len(arrived.hand_points)]
    episode.close()
