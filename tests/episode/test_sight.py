"""What an agent is shown of the wrist camera: the same whoever looked before, and nothing drawn for who does not."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces

from handover_marl.config import OFFICIAL, PandaConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.scene import Scene
from handover_marl.episode import sight as sight_module
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.sight import (
    CLOUDS,
    IMAGES,
    POINTS,
    SIGHTS,
    Sight,
    SightConfig,
    View,
    check_sight,
    sight_space,
)
from handover_marl.errors import OptionError, ResetNeededError, UnknownNameError
from handover_marl.models.poses import compose_point
from handover_marl.policies.policy import Policy
from handover_marl.sim.bullet.fast_world import FastWorld
from handover_marl.sim.camera.imperfections import CameraImperfections
from handover_marl.sim.camera.optics import NOTHING, REFERENCE, TRUE, deproject
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.rays.ray_camera import RayCamera
from handover_marl.sim.renderers import Renderer
from handover_marl.sim.world import Snapshot, World

Observation = dict[str, npt.NDArray[Any]]

DATA = open_dataset("synthetic", robot="panda_camera")
SCENE, OTHER = DATA.scene(9), DATA.scene(14)
GOAL = np.array(PandaConfig().start_joints, dtype=np.float32)
GOAL[:7] += [0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2]
#: More than 1024 pixels show the object, and some the hand.
STEPS = 2000
OBJECT, HAND, COUNTS = "wrist_object_points", "wrist_hand_points", "wrist_point_counts"
PERFECT = CameraImperfections(depth_noise=0.0, edge_drop=0.0, latency=0.0)
NOISY = CameraImperfections(latency=0.0)


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    """A moment of a scene; looking changes nothing of it."""
    episode = Episode("fast")
    episode.reset(SCENE)
    episode.advance(GOAL, STEPS)
    yield episode.world
    episode.close()


def new_sight(world: World, seed: int = 0, **options: Any) -> Sight:
    """In an episode of its own, as far as it knows."""
    sight = Sight(SightConfig(**{"renderer": "rays", **options}), "fast", OFFICIAL.physics)
    sight.reset(SCENE, world)
    sight.seed(seed)
    return sight


def assert_same(first: Observation, second: Observation) -> None:
    assert first.keys() == second.keys()
    for key, value in first.items():
        np.testing.assert_array_equal(value, second[key], err_msg=key)


def as_dict(view: View) -> Observation:
    return dict(vars(view))


def places_in(rows: npt.NDArray[np.float32], cloud: npt.NDArray[np.float32]) -> list[int]:
    """Where rows are in a cloud, all of whose points are different."""
    where = {row.tobytes(): place for place, row in enumerate(cloud)}
    assert len(where) == len(cloud)
    return [where[row.tobytes()] for row in rows]


# -------------------------------------------------------------------------------------------------- names and spaces


def test_sights_by_name() -> None:
    assert SIGHTS == ("points", "images", "clouds")
    for known in (*SIGHTS, None):
        check_sight(known)
    for wrong in ("", "Points", "depth"):
        for check in (check_sight, sight_space):
            with pytest.raises(UnknownNameError, match=f"unknown sight '{wrong}'; valid: points, images, clouds"):
                check(wrong)


def test_spaces_are_as_documented() -> None:
    assert sight_space(None) == {}
    points, images, clouds = (sight_space(sight) for sight in (POINTS, IMAGES, CLOUDS))
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
    for key, high in ((COUNTS, 224 * 224), ("wrist_segmentation", 5), ("wrist_rgb", 255)):
        space = {**points, **images}[key]
        assert isinstance(space, spaces.Box)
        assert (space.low.min(), space.high.max()) == (0, high)


@pytest.mark.parametrize("sight", [*SIGHTS, None])
@pytest.mark.parametrize("camera", [None, "realsense"])
@pytest.mark.parametrize("renderer", ["rays", "bullet"])
def test_observations_are_elements_of_their_space(
    world: World, sight: str | None, camera: str | None, renderer: str
) -> None:
    seen = new_sight(world, renderer=renderer, imperfections=camera).observe(sight, world, STEPS)
    space = spaces.Dict(sight_space(sight))
    assert list(seen) == list(sight_space(sight))
    assert space.contains(seen)
    for key, value in seen.items():
        assert (value.shape, value.dtype) == (space[key].shape, space[key].dtype)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"geometry": "exact"}, UnknownNameError, "unknown geometry 'exact'; valid: reference, true"),
        ({"imperfections": "kinect"}, UnknownNameError, "unknown camera 'kinect'; valid: realsense"),
        ({"imperfections": 0.1}, OptionError, r"imperfections=0\.1"),
        ({"imperfections": True}, OptionError, "imperfections=True"),
    ],
)
def test_wrong_choices_are_refused(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        SightConfig(**options)


def test_results_are_labelled_with_what_was_seen() -> None:
    config = SightConfig(geometry=TRUE)
    assert config.described(None, "all", "fast") == ""
    assert config.described(POINTS, "all", "fast") == "sees points and poses, rays, true geometry"
    assert config.described(IMAGES, "sight", "exact") == "sees images alone, bullet, true geometry"
    told = SightConfig(renderer="bullet", imperfections="realsense").described(POINTS, "all", "fast")
    assert told == f"sees points and poses, bullet, reference geometry, {CameraImperfections()!r}"


# ------------------------------------------------------------------------------------------------ points and images


@pytest.mark.parametrize("geometry", [REFERENCE, TRUE])
def test_views_are_of_one_picture(world: World, geometry: str) -> None:
    """Points are those of depth and segmentation, row by row."""
    view = new_sight(world, geometry=geometry).look(world, STEPS)
    expected = RayCamera(SCENE.assets, OFFICIAL.physics).photograph(world.snapshot(), color=True)
    np.testing.assert_array_equal(view.depth, expected.depth)
    np.testing.assert_array_equal(view.segmentation, expected.segmentation)
    np.testing.assert_array_equal(view.rgb, expected.rgb)
    for points, seen in ((view.object_points, Seen.TARGET), (view.hand_points, Seen.HAND)):
        shown = view.segmentation == seen
        assert points.dtype == np.float32
        assert len(points) == shown.sum() > 50
        np.testing.assert_array_equal(points, deproject(view.depth, shown, geometry))


@pytest.mark.parametrize("camera", [None, NOISY])
def test_many_points_are_thinned_and_few_filled_up(world: World, camera: CameraImperfections | None) -> None:
    sight = new_sight(world, imperfections=camera)
    seen, view = sight.observe(POINTS, world, STEPS), sight.look(world, STEPS)
    assert seen[COUNTS].tolist() == [len(view.object_points), len(view.hand_points)]
    assert seen[COUNTS].tolist() == [(view.segmentation == kind).sum() for kind in (Seen.TARGET, Seen.HAND)]
    places = places_in(seen[OBJECT], view.object_points)
    assert len(view.object_points) > 1100
    assert len(set(places)) == 1024, "without replacement"
    assert places == sorted(places), "in their order"
    # Of all the picture, not of its first rows.
    assert places[0] < 30
    assert places[-1] > len(view.object_points) - 30
    count = len(view.hand_points)
    assert 50 < count < 1024
    np.testing.assert_array_equal(seen[HAND][:count], view.hand_points)
    assert not seen[HAND][count:].any()


@pytest.mark.parametrize("camera", [None, NOISY])
def test_clouds_are_all_that_is_seen(world: World, camera: CameraImperfections | None) -> None:
    sight = new_sight(world, imperfections=camera)
    seen, view = sight.observe(CLOUDS, world, STEPS), sight.look(world, STEPS)
    assert seen[COUNTS].tolist() == [len(view.object_points), len(view.hand_points)]
    for key, points in (("wrist_object_cloud", view.object_points), ("wrist_hand_cloud", view.hand_points)):
        assert len(points) > 50
        np.testing.assert_array_equal(seen[key][: len(points)], points)
        assert not seen[key][len(points) :].any()


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_exact_joints_are_those_that_are_rounded(physics: str) -> None:
    episode = Episode(physics, sight=SightConfig(renderer="bullet"))
    episode.reset(SCENE)
    episode.advance(np.array([0.3, *OFFICIAL.physics.panda.start_joints[1:]], dtype=np.float32), 100)
    exact = episode.observe_sight(CLOUDS)["robot_joint_position_exact"]
    np.testing.assert_array_equal(exact.astype(np.float32), episode.observe()["robot_joint_position"])
    assert (exact != exact.astype(np.float32)).any()
    episode.close()


def test_images_are_the_view(world: World) -> None:
    sight = new_sight(world)
    seen, view = sight.observe(IMAGES, world, STEPS), sight.look(world, STEPS)
    np.testing.assert_array_equal(seen["wrist_depth"][..., 0], view.depth)
    np.testing.assert_array_equal(seen["wrist_segmentation"][..., 0], view.segmentation)
    np.testing.assert_array_equal(seen["wrist_rgb"], view.rgb)
    assert sight.observe(None, world, STEPS) == {}


class DrawnRenderer(Renderer):
    """Shows so many pixels of object and hand, whose depths are all different."""

    def __init__(self, item: int, hand: int) -> None:
        segmentation = np.zeros(224 * 224, dtype=np.uint8)
        segmentation[1 : 2 * item : 2], segmentation[2 * item + 2 : 2 * (item + hand) + 2 : 2] = Seen.TARGET, Seen.HAND
        depth = np.linspace(0.1, 1.9, 224 * 224, dtype=np.float32)
        self.photo = Photo(depth.reshape(224, 224), segmentation.reshape(224, 224), np.zeros((224, 224, 3), np.uint8))

    def photograph(self, world: World, at: Snapshot | None, color: bool) -> Photo:
        return self.photo

    def sought(self, world: World, at: Snapshot | None) -> Photo:
        return self.photo


@pytest.mark.parametrize(("item", "hand"), [(0, 0), (1, 1023), (1024, 1025), (1025, 1024), (20_000, 5000)])
def test_counts_about_as_many_as_rows(monkeypatch: pytest.MonkeyPatch, world: World, item: int, hand: int) -> None:
    monkeypatch.setattr(sight_module, "make_renderer", lambda *_: DrawnRenderer(item, hand))
    sight = new_sight(world)
    seen, view = sight.observe(POINTS, world, STEPS), sight.look(world, STEPS)
    assert seen[COUNTS].tolist() == [item, hand]
    for key, cloud in ((OBJECT, view.object_points), (HAND, view.hand_points)):
        kept = min(len(cloud), 1024)
        places = places_in(seen[key][:kept], cloud)
        assert places == sorted(set(places))
        assert (places == list(range(len(cloud)))) == (len(cloud) <= 1024)
        assert not seen[key][kept:].any()


def test_object_and_hand_are_thinned_by_draws_of_their_own(monkeypatch: pytest.MonkeyPatch, world: World) -> None:
    monkeypatch.setattr(sight_module, "make_renderer", lambda *_: DrawnRenderer(3000, 3000))
    sight = new_sight(world)
    seen, view = sight.observe(POINTS, world, STEPS), sight.look(world, STEPS)
    first, second = places_in(seen[OBJECT], view.object_points), places_in(seen[HAND], view.hand_points)
    assert first != second
    # Every part of a cloud has its share.
    for places in (first, second):
        shares = np.histogram(places, bins=10, range=(0, 3000))[0]
        assert shares.min() > 60
        assert shares.max() < 145


# ------------------------------------------------------------------------------------- whoever looked, and how often


LOOKS: list[Callable[[Sight, World], object]] = [
    lambda sight, world: None,
    lambda sight, world: sight.look(world, STEPS),
    lambda sight, world: sight.observe(POINTS, world, STEPS),
    lambda sight, world: sight.observe(IMAGES, world, STEPS),
    lambda sight, world: sight.look(world, STEPS - 1),
    lambda sight, world: sight.observe(POINTS, world, STEPS - 1),
]


@pytest.mark.parametrize("camera", [None, NOISY])
@pytest.mark.parametrize("renderer", ["rays", "bullet"])
def test_what_is_seen_does_not_depend_on_who_looked_before(
    world: World, renderer: str, camera: CameraImperfections | None
) -> None:
    """To the bit, although points alone are drawn otherwise than whole pictures."""
    expected = new_sight(world, 3, renderer=renderer, imperfections=camera)
    points = expected.observe(POINTS, world, STEPS)
    view = as_dict(expected.look(world, STEPS))
    for look in LOOKS:
        sight = new_sight(world, 3, renderer=renderer, imperfections=camera)
        look(sight, world)
        assert_same(sight.observe(POINTS, world, STEPS), points)
        assert_same(as_dict(sight.look(world, STEPS)), view)
        assert_same(sight.observe(POINTS, world, STEPS), points)


@pytest.mark.parametrize("camera", [None, NOISY])
def test_draws_repeat_from_seed_and_step(world: World, camera: CameraImperfections | None) -> None:
    def drawn(seed: int, steps: int) -> npt.NDArray[np.float32]:
        return new_sight(world, seed, imperfections=camera).observe(POINTS, world, steps)[OBJECT]

    np.testing.assert_array_equal(drawn(1, STEPS), drawn(1, STEPS))
    for other in (drawn(2, STEPS), drawn(1, STEPS + 1), drawn(STEPS, 1)):
        assert (drawn(1, STEPS) != other).any()
    sight = new_sight(world, 0, imperfections=camera)
    first = sight.observe(POINTS, world, STEPS)
    for seed in (1, 2, 1):
        sight.seed(seed)
        np.testing.assert_array_equal(sight.observe(POINTS, world, STEPS)[OBJECT], drawn(seed, STEPS))
    sight.seed(0)
    assert_same(sight.observe(POINTS, world, STEPS), first)
    unseeded = Sight(SightConfig(renderer="rays", imperfections=camera), "fast", OFFICIAL.physics)
    unseeded.reset(SCENE, world)
    assert_same(unseeded.observe(POINTS, world, STEPS), first)


@pytest.mark.parametrize("camera", [None, NOISY])
def test_arrays_may_be_written_to(world: World, camera: CameraImperfections | None) -> None:
    sight, fresh = (new_sight(world, imperfections=camera) for _ in range(2))
    for look in (
        lambda of: of.observe(POINTS, world, STEPS),
        lambda of: of.observe(IMAGES, world, STEPS),
        lambda of: as_dict(of.look(world, STEPS)),
    ):
        seen = look(sight)
        for value in seen.values():
            value[...] = 7
        assert_same(look(sight), look(fresh))
        assert_same(look(sight), look(fresh))


def test_two_clouds_are_two_arrays(world: World) -> None:
    seen = new_sight(world).observe(POINTS, world, STEPS)
    seen[OBJECT][...] = 7.0
    assert seen[HAND].max() < 7.0


# ------------------------------------------------------------------------------------------------- what is drawn when


class Drawings:
    """Counts what is asked of ray casters and of worlds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = dict.fromkeys(["made", "whole", "sought", "engine"], 0)
        for owner, name, kind in (
            (RayCamera, "__init__", "made"),
            (RayCamera, "photograph", "whole"),
            (RayCamera, "sought", "sought"),
            (FastWorld, "photograph", "engine"),
        ):
            monkeypatch.setattr(owner, name, self._counted(getattr(owner, name), kind))

    def _counted(self, call: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def counted(*args: Any, **options: Any) -> Any:
            self.count[kind] += 1
            return call(*args, **options)

        return counted

    def taken(self) -> tuple[int, ...]:
        return tuple(self.count.values())


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> Drawings:
    return Drawings(monkeypatch)


class Looker(Policy):
    """A receiver that is asked every 50 ms and sees what it is told to."""

    name, hold_time = "looker", 0.05

    def __init__(self, **wishes: str | None) -> None:
        vars(self).update(wishes)
        self.seen: list[Observation] = []

    def reset(self, seed: int | None = None) -> None:
        self.seen.clear()

    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        self.seen.append({key: value for key, value in observation.items() if key.startswith("wrist_")})
        return GOAL


@pytest.mark.parametrize("camera", [None, "realsense"])
@pytest.mark.parametrize("wishes", [{}, {"sight": None}, {"sight": None, "observes": "all"}])
def test_nothing_is_drawn_for_who_does_not_look(
    drawings: Drawings, camera: str | None, wishes: dict[str, str | None]
) -> None:
    episode, looker = Episode("fast", sight=SightConfig(imperfections=camera)), Looker(**wishes)
    episode.reset(SCENE)
    play(episode, looker, until=200)
    assert looker.seen == [{}] * 4
    assert drawings.taken() == (0, 0, 0, 0)
    episode.close()


@pytest.mark.parametrize(
    ("sight", "camera", "expected"),
    [
        (POINTS, None, (1, 0, 4, 0)),
        (IMAGES, None, (1, 4, 0, 0)),
        (CLOUDS, None, (1, 0, 4, 0)),
        # Edges are those of whole pictures.
        (POINTS, NOISY, (1, 4, 0, 0)),
    ],
)
def test_who_looks_has_one_picture_drawn_a_decision(
    drawings: Drawings, sight: str, camera: CameraImperfections | None, expected: tuple[int, ...]
) -> None:
    episode, looker = Episode("fast", sight=SightConfig(imperfections=camera)), Looker(sight=sight)
    episode.reset(SCENE)
    play(episode, looker, until=200)
    keys = [key for key in sight_space(sight) if key.startswith("wrist")]
    assert [list(seen) for seen in looker.seen] == [keys] * 4
    assert drawings.taken() == expected
    # Seen by the seed of the episode, as anybody sees it now who looks again.
    assert_same(episode.observe_sight(sight), episode.observe_sight(sight))
    episode.close()


def test_a_moment_is_drawn_once(world: World, drawings: Drawings) -> None:
    sight = new_sight(world)
    assert drawings.taken() == (0, 0, 0, 0)
    for _ in range(3):
        sight.observe(POINTS, world, STEPS)
    assert drawings.taken() == (1, 0, 1, 0)
    for _ in range(3):
        sight.look(world, STEPS)
        sight.observe(IMAGES, world, STEPS)
        sight.observe(POINTS, world, STEPS)
    assert drawings.taken() == (1, 1, 1, 0)
    sight.look(world, STEPS + 1)
    sight.observe(POINTS, world, STEPS + 1)
    assert drawings.taken() == (1, 2, 1, 0)
    sight.reset(SCENE, world)
    sight.observe(POINTS, world, STEPS + 1)
    assert drawings.taken() == (1, 2, 2, 0), "models are kept as long as the scene stays"
    new_sight(world, renderer="bullet").observe(POINTS, world, STEPS)
    assert drawings.taken() == (1, 2, 2, 1)


@pytest.mark.parametrize("camera", [None, "realsense"])
@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_scenes_do_not_show_in_each_other(physics: str, camera: str | None) -> None:
    """The first step of one scene and of another have the same number."""
    config = SightConfig(renderer="rays", imperfections=camera)
    used, fresh = Episode(physics, sight=config), {}
    for number, scene in enumerate((SCENE, OTHER, SCENE)):
        used.reset(scene)
        used.seed_sight(5)
        name = scene.info.name
        seen = {**used.observe_sight(POINTS), **as_dict(used.look())}
        if number < 2:
            fresh[name] = seen
        else:
            assert_same(seen, fresh[name])
        used.advance(GOAL, 60)
        used.look()
    first, second = fresh.values()
    assert (first["depth"] != second["depth"]).any()
    assert first[COUNTS].tolist() != second[COUNTS].tolist()
    used.close()


def test_before_a_scene_there_is_nothing_to_see(world: World) -> None:
    episode = Episode("fast")
    for look in (episode.look, lambda: episode.observe_sight(POINTS)):
        with pytest.raises(ResetNeededError):
            look()
    sight = Sight(SightConfig(), "fast", OFFICIAL.physics)
    assert sight.observe(None, world, 0) == {}
    with pytest.raises(ResetNeededError):
        sight.observe(POINTS, world, 0)


# -------------------------------------------------------------------------------------------------- cameras' faults


def test_the_preset_is_what_it_says(world: World) -> None:
    preset, own = (
        new_sight(world, 4, imperfections=camera).observe(IMAGES, world, STEPS)
        for camera in ("realsense", CameraImperfections(0.0036, 0.02, 0.5, 0.05))
    )
    assert_same(preset, own)
    assert SightConfig(imperfections="realsense").camera == CameraImperfections()


def test_a_camera_without_faults_is_perfect(world: World) -> None:
    for renderer in ("rays", "bullet"):
        perfect = new_sight(world, 1, renderer=renderer)
        flawless = new_sight(world, 1, renderer=renderer, imperfections=PERFECT)
        assert not flawless.remembers
        assert_same(flawless.observe(POINTS, world, STEPS), perfect.observe(POINTS, world, STEPS))
        assert_same(as_dict(flawless.look(world, STEPS)), as_dict(perfect.look(world, STEPS)))


def beside_edges(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    framed = np.pad(depth, 1, mode="edge")
    neighbours = (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:])
    return np.array(np.any([np.abs(other - depth) > 0.02 for other in neighbours], axis=0))


def test_noise_and_holes_are_those_of_the_camera(world: World) -> None:
    perfect = new_sight(world).look(world, STEPS)
    views = [new_sight(world, seed, imperfections=NOISY).look(world, STEPS) for seed in (1, 1, 2)]
    assert_same(as_dict(views[0]), as_dict(views[1]))
    assert (views[0].depth != views[2].depth).mean() > 0.3
    there, edges = perfect.depth < NOTHING, beside_edges(perfect.depth)
    lost = there & (views[0].depth == NOTHING)
    assert not (lost & ~edges).any()
    assert lost.sum() == pytest.approx(0.5 * (there & edges).sum(), rel=0.1)
    assert not views[0].segmentation[lost].any()
    np.testing.assert_array_equal(views[0].segmentation[~lost], perfect.segmentation[~lost])
    np.testing.assert_array_equal(views[0].rgb, perfect.rgb)
    kept = there & ~lost
    apart = (views[0].depth - perfect.depth)[kept] / perfect.depth[kept] ** 2
    assert apart.std() == pytest.approx(0.0036, rel=0.03)
    # As much for what is near as for what is far.
    near = perfect.depth[kept] < np.median(perfect.depth[kept])
    assert apart[near].std() == pytest.approx(apart[~near].std(), rel=0.1)


def test_clouds_of_bad_cameras_are_those_of_their_pictures(world: World) -> None:
    sight = new_sight(world, 2, imperfections=NOISY, geometry=TRUE)
    view, perfect = sight.look(world, STEPS), new_sight(world, geometry=TRUE).look(world, STEPS)
    np.testing.assert_array_equal(view.object_points, deproject(view.depth, view.segmentation == Seen.TARGET, TRUE))
    assert len(view.object_points) < len(perfect.object_points)
    assert sight.observe(POINTS, world, STEPS)[COUNTS].tolist() == [len(view.object_points), len(view.hand_points)]


class Diary:
    """What a perfect camera saw at every step."""

    def __init__(self, episode: Episode, renderer: str, physics: str, scene: Scene) -> None:
        self._sight = Sight(SightConfig(renderer=renderer), physics, OFFICIAL.physics)
        self._sight.reset(scene, episode.world)
        self.views = {0: self._sight.look(episode.world, 0)}
        self.links = {0: episode.observe()["gripper_pose"]}
        self.wanted: set[int] = set()

    def __call__(self, episode: Episode) -> None:
        if episode.steps in self.wanted:
            self.views[episode.steps] = self._sight.look(episode.world, episode.steps)
            self.links[episode.steps] = episode.observe()["gripper_pose"]

    def assert_arrived(self, episode: Episode, step: int) -> None:
        """What is seen now is what was to be seen then: the same pictures, and points at the same places."""
        arrived, then = as_dict(episode.look()), as_dict(self.views[step])
        now = episode.observe()["gripper_pose"]
        for name in ("object_points", "hand_points"):
            seen, was = arrived.pop(name), then.pop(name)
            assert seen.dtype == np.float32
            if (now == self.links[step]).all():
                np.testing.assert_array_equal(seen, was)
            places, before = compose_point(now, seen), compose_point(self.links[step], was)
            np.testing.assert_allclose(places, before, rtol=0.0, atol=5e-6)
        assert_same(arrived, then)


def late(latency: float) -> CameraImperfections:
    return CameraImperfections(depth_noise=0.0, edge_drop=0.0, latency=latency)


@pytest.mark.parametrize("latency", [0.001, 0.05, 0.13])
@pytest.mark.parametrize("chunk", [50, 7])
def test_late_pictures_are_those_of_earlier_moments(latency: float, chunk: int) -> None:
    delay = round(1000 * latency)
    episode = Episode("fast", sight=SightConfig(renderer="rays", imperfections=late(latency)))
    for scene in (SCENE, OTHER):
        # Nothing of the scene before is left.
        episode.reset(scene)
        diary = Diary(episode, "rays", "fast", scene)
        diary.assert_arrived(episode, 0)
        ends = [min(10, delay), delay, delay + 1, 180, 287]
        diary.wanted = {end - delay + more for end in ends for more in (-1, 0, 1)}
        for end in ends:
            while episode.steps < end:
                episode.advance(GOAL, min(chunk, end - episode.steps), on_step=[diary])
            arrived = episode.look()
            diary.assert_arrived(episode, max(0, end - delay))
            if end > delay:
                assert (arrived.depth != diary.views[end - delay - 1].depth).any()
            counts = episode.observe_sight(POINTS)[COUNTS].tolist()
            assert counts == [len(arrived.object_points), len(arrived.hand_points)]
    episode.close()


@pytest.mark.parametrize("renderer", ["rays", "bullet"])
def test_late_pictures_of_exact_physics_are_those_of_earlier_moments(renderer: str) -> None:
    """With and without a hand, which comes after 0.4 s; the engine draws the past in a server of its own."""
    episode = Episode("exact", sight=SightConfig(renderer=renderer, imperfections=late(0.1)))
    episode.reset(OTHER)
    diary = Diary(episode, renderer, "exact", OTHER)
    diary.wanted = {350, 450}
    for end in (450, 550):
        episode.advance(GOAL, end - episode.steps, on_step=[diary])
        arrived, then = episode.look(), diary.views[end - 100]
        assert bool(len(arrived.hand_points)) == (end == 550)
        assert (arrived.segmentation != then.segmentation).mean() < 1e-3
        assert (np.abs(arrived.depth - then.depth) > 1e-4).mean() < 1e-3
        if renderer == "rays":
            diary.assert_arrived(episode, end - 100)
    episode.close()


def test_only_late_cameras_remember() -> None:
    for camera, remembers in (
        (None, False),
        (PERFECT, False),
        (NOISY, False),
        (late(0.001), True),
        ("realsense", True),
    ):
        assert Sight(SightConfig(imperfections=camera), "fast", OFFICIAL.physics).remembers == remembers


def test_late_clouds_do_not_depend_on_who_looked_before() -> None:
    seen: list[list[Observation]] = []
    for nosy in (False, True):
        episode = Episode("fast", sight=SightConfig(imperfections="realsense"))
        episode.reset(SCENE)
        episode.seed_sight(3)
        seen.append([])
        for _ in range(4):
            episode.advance(GOAL, 30)
            if nosy:
                episode.look()
                episode.observe_sight(IMAGES)
            seen[-1].append(episode.observe_sight(POINTS))
        episode.close()
    for calm, watched in zip(*seen, strict=True):
        assert_same(calm, watched)


def test_receivers_see_by_the_seed_of_their_episode() -> None:
    """Points are drawn anew in every episode and are the same in the same one."""
    episode, clouds = Episode("fast"), []
    for seed in (0, 1, 0):
        looker = Looker(sight=POINTS)
        episode.reset(SCENE)
        episode.advance(GOAL, STEPS)
        play(episode, looker, seed=seed, until=STEPS + 100)
        assert min(seen[COUNTS][0] for seen in looker.seen) > 1024
        clouds.append(looker.seen)
    for first, other, again in zip(*clouds, strict=True):
        assert_same(first, again)
        assert (first[OBJECT] != other[OBJECT]).any()
        np.testing.assert_array_equal(first[COUNTS], other[COUNTS])
    episode.close()
