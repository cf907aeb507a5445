"""Pictures by rays beside those of Bullet's software renderer, of motion and of things put anywhere by hand."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.config import OFFICIAL, PandaConfig, PhysicsConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.scene import Scene, SceneAssets
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError, HandoverError, SimulationError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import FINGERTIPS, HAND_LINK, LOWER_LIMITS, PANDA, PANDA_CAMERA, UPPER_LIMITS
from handover_marl.sim.bullet.picture_world import PictureWorld
from handover_marl.sim.camera.optics import NEAR, NOTHING, TRUE, deproject
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.rays.ray_camera import RayCamera
from handover_marl.sim.world import Snapshot

Array = npt.NDArray[np.float64]

DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
START = np.array(PandaConfig().start_joints, dtype=np.float32)
SOUGHT = (Seen.TARGET, Seen.HAND)
#: With five, three and four objects, and hands of both sides.
SCENES = (9, 209, 14)
#: The camera's axes (right, down, ahead) in the hand link, as columns, and its pinhole.
_AXES, _PINHOLE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), (0.036, 0.0, 0.036)

seeds = st.integers(0, 2**32 - 1)


def hand_frame(robot: npt.NDArray[np.float32], urdf: Path, config: PhysicsConfig) -> tuple[Rotation, Array]:
    """Where the Panda's hand link is in the world."""
    tree = read_tree(urdf)
    origins, turns = (value[0] for value in tree.frames(robot[None]))
    link = [joint.link for joint in tree.joints].index(HAND_LINK)
    base = Rotation.from_quat(config.panda.base_orientation)
    return base * Rotation.from_matrix(turns[link]), base.apply(origins[link]) + config.panda.base_position


@dataclass(frozen=True, eq=False, repr=False)
class Stand:
    """A scene before both renderers."""

    scene: Scene
    rays: RayCamera
    engine: PictureWorld
    config: PhysicsConfig

    def in_view(self, robot: npt.NDArray[np.float32], places: npt.ArrayLike) -> Array:
        """(n, 3) in the world of places that are told right, down and ahead of the camera."""
        turn, origin = hand_frame(robot, self.scene.assets.panda, self.config)
        return np.array(origin + turn.apply(np.asarray(places) @ _AXES.T + _PINHOLE))

    def thrown(self, rng: np.random.Generator, near: float = 0.0, far: float = 0.6) -> Snapshot:
        """The arm in any pose, and things before its camera, so many metres away, in each other and in the robot."""
        low, high = np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
        robot = (low + rng.uniform(0.1, 0.9, 9) * (high - low)).astype(np.float32)
        count = len(self.scene.assets.objects) + 1
        ahead = rng.uniform(near, far, (count, 1))
        aside = rng.uniform(-0.7, 0.7, (count, 2)) * np.maximum(np.abs(ahead), 0.05)
        dof = np.c_[self.in_view(robot, np.c_[aside, ahead]), rng.uniform(-np.pi, np.pi, (count, 3))]
        # The ground hides object and hand in whole pictures only, but nothing ever is below it.
        dof[:, 2] = np.maximum(dof[:, 2], 0.3)
        hand = np.concatenate([dof[0], rng.uniform(-0.8, 0.8, 45)])
        return Snapshot(robot, hand.astype(np.float32), dof[1:].astype(np.float32))


def make_stand(scene: Scene, config: PhysicsConfig = OFFICIAL.physics) -> Stand:
    return Stand(scene, RayCamera(scene.assets, config), PictureWorld(scene, config), config)


@pytest.fixture(scope="module")
def stands() -> Iterator[dict[int, Stand]]:
    made = {scene_id: make_stand(DATA.scene(scene_id)) for scene_id in SCENES}
    yield made
    for stand in made.values():
        stand.engine.close()


def assert_same_bits(first: Photo, second: Photo) -> None:
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.segmentation, second.segmentation)


class Agreement:
    """Pixels that two renderers see alike, over several pictures; (n, 6) by what is seen."""

    def __init__(self) -> None:
        self.both, self.either, self.near = (np.zeros((0, 6), dtype=int) for _ in range(3))

    def add(self, drawn: Photo, cast: Photo) -> None:
        shown = [(drawn.shows(seen), cast.shows(seen)) for seen in Seen]
        near = np.abs(drawn.depth - cast.depth) < 1e-4
        self.both = np.r_[self.both, [[(one & other).sum() for one, other in shown]]]
        self.either = np.r_[self.either, [[(one | other).sum() for one, other in shown]]]
        self.near = np.r_[self.near, [[(one & other & near).sum() for one, other in shown]]]

    def seen(self, *wanted: Seen) -> int:
        return int(self.either[:, list(wanted)].sum())

    def check(self, *wanted: Seen, least: int = 500, alike: float = 0.999) -> None:
        """As asked for, of what is wanted, and of all else; and more than a few pixels of each that is wanted."""
        for kinds in (wanted, Seen):
            both, either, near = (value[:, list(kinds)].sum() for value in (self.both, self.either, self.near))
            assert both >= alike * either
            assert near >= 0.99 * both
        assert min(self.seen(kind) for kind in wanted) >= least


# ---------------------------------------------------------------------------------------------- beside the engine


@pytest.mark.parametrize("scene_id", SCENES)
def test_rays_meet_what_the_engine_draws_wherever_things_are(stands: dict[int, Stand], scene_id: int) -> None:
    stand, agreement, rng = stands[scene_id], Agreement(), np.random.default_rng(scene_id)
    for _ in range(7):
        now = stand.thrown(rng)
        agreement.add(stand.engine.photograph(now, False), stand.rays.photograph(now, False))
    agreement.check(*SOUGHT, Seen.OTHER_OBJECT, Seen.ROBOT, least=2000)
    # Ground and table are in some of them, and so is nothing at all.
    assert min(agreement.seen(Seen.BACKGROUND), agreement.seen(Seen.TABLE)) > 2000


def test_rays_meet_what_the_engine_draws_of_far_things(stands: dict[int, Stand]) -> None:
    """Up to where the picture ends, and through it. The engine leaves triangles out that are far less than a pixel."""
    stand, agreement, rng, farthest = stands[9], Agreement(), np.random.default_rng(4), []
    for _ in range(8):
        now = stand.thrown(rng, 1.2, 2.1)
        drawn, cast = stand.engine.photograph(now, False), stand.rays.photograph(now, False)
        agreement.add(drawn, cast)
        farthest.append(cast.depth[cast.segmentation > Seen.TABLE].max(initial=0.0))
    agreement.check(*SOUGHT, Seen.OTHER_OBJECT, least=200, alike=0.995)
    assert 1.98 < max(farthest) < NOTHING


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_rays_meet_what_the_engine_draws_of_motion(physics: str) -> None:
    """The arm goes to where it sees the hand, which is there after 0.4 s."""
    scene, agreement = DATA.scene(14), Agreement()
    episode, camera = Episode(physics), RayCamera(scene.assets, OFFICIAL.physics)
    episode.reset(scene)
    goal = START + np.array([0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2, -0.02, -0.01], dtype=np.float32)
    for steps in (1, 499, 200, 200, 200, 100):
        episode.advance(goal, steps)
        agreement.add(episode.world.photograph(False), camera.photograph(episode.world.snapshot(), False))
    agreement.check(*SOUGHT)
    assert episode.steps == 1200
    episode.close()


def grasped(stand: Stand, robot: npt.NDArray[np.float32], place: npt.ArrayLike, turn: list[float]) -> Snapshot:
    """The target in the gripper, told in the hand link's frame; the hand a little behind it, other things far away."""
    frame, origin = hand_frame(robot, stand.scene.assets.panda, stand.config)
    points = origin + frame.apply([place, np.add(place, (0.05, 0.0, 0.1))])
    angles = (frame * Rotation.from_euler("XYZ", turn)).as_euler("XYZ")
    objects = np.zeros((len(stand.scene.assets.objects), 6), dtype=np.float32)
    objects[:, :3] = (5.0, 5.0, 1.0)
    objects[0] = np.concatenate([points[0], angles])
    return Snapshot(robot, np.concatenate([points[1], np.zeros(48)]).astype(np.float32), objects)


@pytest.mark.parametrize("fingers", [0.0, 0.03])
@pytest.mark.parametrize(
    ("place", "seen"),
    [(FINGERTIPS, True), ((0.16, 0.0, 0.09), True), ((0.036, -0.1, 0.07), True), ((0.03, 0.01, 0.036), False)],
)
def test_rays_meet_what_the_engine_draws_of_a_grasped_object(
    stands: dict[int, Stand], place: tuple[float, ...], seen: bool, fingers: float
) -> None:
    """Between the fingers, through the near plane on two sides, and all around the camera, where it is not seen."""
    stand, agreement, robot = stands[209], Agreement(), START.copy()
    robot[7:] = fingers
    for turn in ([0.0, 0.0, 0.0], [0.3, 1.2, -0.5], [1.5, 0.1, 0.7], [-0.5, 0.5, 2.0]):
        now = grasped(stand, robot, place, turn)
        assert_sought_is_part_of_the_whole(stand.rays, now)
        agreement.add(stand.engine.photograph(now, False), stand.rays.photograph(now, False))
    agreement.check(*(SOUGHT if seen else [Seen.HAND]))
    assert seen == bool(agreement.seen(Seen.TARGET))


def test_without_a_hand_none_is_seen(stands: dict[int, Stand]) -> None:
    stand, rng = stands[9], np.random.default_rng(3)
    here = stand.thrown(rng)
    gone = here._replace(hand=None)
    with_hand, without = (stand.rays.photograph(now, False) for now in (here, gone))
    assert with_hand.shows(Seen.HAND).sum() > 100
    assert not without.shows(Seen.HAND).any()
    kept = ~with_hand.shows(Seen.HAND)
    np.testing.assert_array_equal(without.segmentation[kept], with_hand.segmentation[kept])
    agreement = Agreement()
    agreement.add(stand.engine.photograph(gone, False), without)
    agreement.check(Seen.TARGET, least=100)
    assert_sought_is_part_of_the_whole(stand.rays, gone)
    assert_same_bits(stand.rays.photograph(here, False), with_hand)


def test_robot_and_table_stand_where_they_are_configured_to() -> None:
    base = (0.3, -0.3, 0.9), (0.1830127, 0.1830127, 0.6830127, 0.6830127)
    panda = replace(PandaConfig(), base_position=base[0], base_orientation=base[1])
    config = PhysicsConfig(panda=panda, table_position=(0.35, 0.1, -0.1))
    stand, agreement, rng = make_stand(DATA.scene(209), config), Agreement(), np.random.default_rng(1)
    for _ in range(4):
        now = stand.thrown(rng)
        agreement.add(stand.engine.photograph(now, False), stand.rays.photograph(now, False))
    agreement.check(Seen.TARGET, Seen.ROBOT, Seen.TABLE)
    stand.engine.close()


def test_objects_of_one_model_are_told_apart() -> None:
    """A target beside three others of its own class, each in its place."""
    scene = DATA.scene(209)
    assets = replace(scene.assets, objects=scene.assets.objects[:1] * 4)
    ids = scene.info.object_ids[:1] * 4
    several = replace(scene, assets=assets, info=replace(scene.info, object_ids=ids))
    stand = make_stand(several)
    places = stand.in_view(START, [[-0.3, 0.0, 0.6], [0.3, 0.0, 0.6], [0.0, -0.3, 0.6], [0.0, 0.3, 0.6]])
    now = Snapshot(START, None, np.c_[places, np.zeros((4, 3))].astype(np.float32))
    drawn, cast = stand.engine.photograph(now, False), stand.rays.photograph(now, False)
    agreement = Agreement()
    agreement.add(drawn, cast)
    agreement.check(Seen.TARGET, Seen.OTHER_OBJECT)
    assert cast.shows(Seen.TARGET)[:, :100].any()
    assert not cast.shows(Seen.TARGET)[:, 100:].any()
    assert cast.shows(Seen.OTHER_OBJECT)[:, 160:].any()
    stand.engine.close()


# ------------------------------------------------------------------------------------------------ object and hand


def assert_sought_is_part_of_the_whole(rays: RayCamera, now: Snapshot) -> Photo:
    """To the bit, and all else is nothing."""
    whole, part = rays.photograph(now, False), rays.sought(now)
    wanted = whole.shows(Seen.TARGET) | whole.shows(Seen.HAND)
    np.testing.assert_array_equal(part.segmentation, np.where(wanted, whole.segmentation, 0))
    np.testing.assert_array_equal(part.depth, np.where(wanted, whole.depth, NOTHING))
    return part


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(SCENES), seeds, st.sampled_from([(0.0, 0.3), (-0.1, 0.6), (0.3, 1.8)]))
def test_object_and_hand_alone_are_those_of_the_whole_picture(
    stands: dict[int, Stand], scene_id: int, seed: int, depths: tuple[float, float]
) -> None:
    now = stands[scene_id].thrown(np.random.default_rng(seed), *depths)
    assert_sought_is_part_of_the_whole(stands[scene_id].rays, now)


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_what_hides_all_of_object_and_hand_leaves_nothing(stands: dict[int, Stand], seed: int) -> None:
    """The second object, a gelatin box, before the camera; object and hand behind it."""
    stand, rng = stands[209], np.random.default_rng(seed)
    now = stand.thrown(rng, 0.8, 1.2)
    now.objects[1:, :3] = stand.in_view(now.robot, [0.0, 0.0, 0.07])
    part = assert_sought_is_part_of_the_whole(stand.rays, now)
    behind = stand.rays.photograph(now, False).shows(Seen.OTHER_OBJECT)
    assert behind.any()
    assert not part.segmentation[behind].any()


def test_neither_object_nor_hand_in_view_is_an_empty_picture(stands: dict[int, Stand]) -> None:
    stand = stands[9]
    now = stand.thrown(np.random.default_rng(0))
    now.objects[0, :3] = now.hand[:3] = stand.in_view(now.robot, [0.0, 0.0, -1.0])  # type: ignore[index]
    part = assert_sought_is_part_of_the_whole(stand.rays, now)
    assert not part.segmentation.any()
    assert (part.depth == NOTHING).all()


# ------------------------------------------------------------------------------------------------------- pictures


def test_pictures_are_the_same_whatever_was_taken_before(stands: dict[int, Stand]) -> None:
    """Bodies are shared by scenes and remember what they were asked last."""
    views = [(stand, stand.thrown(np.random.default_rng(number))) for number in range(3) for stand in stands.values()]
    still = [(stand, now._replace(robot=views[0][1].robot)) for stand, now in views[:3]]
    views += still
    taken = [stand.rays.photograph(now, True) for stand, now in views]
    again = [stand.rays.photograph(now, True) for stand, now in views[::-1]][::-1]
    for (stand, now), first, second in zip(views, taken, again, strict=True):
        assert_same_bits(first, second)
        np.testing.assert_array_equal(first.rgb, second.rgb)
        stand.rays.sought(now)
        assert_same_bits(first, RayCamera(stand.scene.assets, OFFICIAL.physics).photograph(now, False))


def test_joints_that_are_written_over_are_seen(stands: dict[int, Stand]) -> None:
    stand, rng = stands[9], np.random.default_rng(8)
    first, second = stand.thrown(rng), stand.thrown(rng)
    expected = stand.rays.photograph(second, False)
    held = Snapshot(*(value.copy() for value in first if value is not None))
    stand.rays.photograph(held, False)
    for value, new in zip(held, second, strict=True):
        value[...] = new  # type: ignore[index]
    assert_same_bits(stand.rays.photograph(held, False), expected)


def test_taking_pictures_changes_no_joint(stands: dict[int, Stand]) -> None:
    now = stands[9].thrown(np.random.default_rng(2))
    before = [value.copy() for value in now if value is not None]
    first = stands[9].rays.photograph(now, True)
    stands[9].rays.sought(now).depth[...] = 0.0
    for value, old in zip(now, before, strict=True):
        np.testing.assert_array_equal(value, old)
    kept = first.depth.copy(), first.segmentation.copy()
    first.depth[...], first.segmentation[...] = 0.0, 0
    again = stands[9].rays.photograph(now, True)
    np.testing.assert_array_equal(again.depth, kept[0])
    np.testing.assert_array_equal(again.segmentation, kept[1])


def test_a_panda_without_camera_has_the_same_view(stands: dict[int, Stand]) -> None:
    plain = open_dataset("synthetic", robot=PANDA).scene(209)
    assert plain.assets.panda != stands[209].scene.assets.panda
    for seed in range(2):
        now = stands[209].thrown(np.random.default_rng(seed))
        expected = stands[209].rays.photograph(now, False)
        assert_same_bits(RayCamera(plain.assets, OFFICIAL.physics).photograph(now, False), expected)


def test_colours_change_nothing_and_are_those_of_the_materials(stands: dict[int, Stand]) -> None:
    stand = stands[14]
    now = stand.thrown(np.random.default_rng(5))
    plain, photo = stand.rays.photograph(now, False), stand.rays.photograph(now, True)
    assert plain.rgb is None
    assert photo.rgb is not None
    assert_same_bits(plain, photo)
    assert (photo.rgb.shape, photo.rgb.dtype) == ((224, 224, 3), np.uint8)
    assert (photo.rgb[photo.depth == NOTHING] == 255).all()
    # Every material has one hue; light makes it darker by half at most, and not everywhere alike.
    (skin,) = {tuple(color) for colors in stand.rays._hand.colors for color in colors.tolist()}
    light = photo.rgb[photo.shows(Seen.HAND)] / (255.0 * np.array(skin))
    assert 0.49 < light.min() < 0.75 < light.max() < 1.01
    np.testing.assert_allclose(light, light.mean(axis=1, keepdims=True) * np.ones(3), atol=0.01)
    assert np.ptp(light.mean(axis=1)) > 0.2


def test_pictures_have_their_form(stands: dict[int, Stand]) -> None:
    stand = stands[209]
    now = stand.thrown(np.random.default_rng(6))
    for photo in (stand.rays.photograph(now, False), stand.rays.sought(now)):
        assert (photo.depth.shape, photo.depth.dtype) == ((224, 224), np.float32)
        assert (photo.segmentation.shape, photo.segmentation.dtype) == ((224, 224), np.uint8)
        assert NEAR <= photo.depth.min() < photo.depth.max() == NOTHING
        assert (photo.depth[photo.segmentation > 0] < NOTHING).all()
        assert set(np.unique(photo.segmentation).tolist()) <= set(Seen)


# -------------------------------------------------------------------------------------------------------- models

_CHAIN = "".join(
    f'<link name="l{number}"/><joint name="j{number}" type="{kind}"><parent link="l{number - 1}"/>'
    f'<child link="l{number}"/><axis xyz="{axis}"/></joint>'
    for number, (kind, axis) in enumerate(
        [(kind, axis) for kind in ("prismatic", "continuous") for axis in ("1 0 0", "0 1 0", "0 0 1")], start=1
    )
)


def write_box(path: Path, size: str) -> Path:
    """An object's chain with a box at its end."""
    box = f'<visual><geometry><box size="{size}"/></geometry></visual>'
    chain = _CHAIN.replace('<link name="l6"/>', f'<link name="l6">{box}</link>')
    path.write_text(f'<robot name="box"><link name="l0"/>{chain}</robot>')
    return path


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_true_points_lie_on_what_is_seen(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """From the picture of a box back into its own frame; HandoverSim's are a pixel beside it."""
    scene, rng = DATA.scene(209), np.random.default_rng(seed)
    half = np.array([0.05, 0.08, 0.11])
    urdf = write_box(tmp_path_factory.mktemp("box") / "box.urdf", "0.1 0.16 0.22")
    camera = RayCamera(replace(scene.assets, objects=(urdf,)), OFFICIAL.physics)
    frame, origin = hand_frame(START, scene.assets.panda, OFFICIAL.physics)
    angles = rng.uniform(-np.pi, np.pi, 3)
    middle = origin + frame.apply(np.append(rng.uniform(-0.1, 0.2, 2), 0.45))
    now = Snapshot(START, None, np.append(middle, angles)[None].astype(np.float32))
    for take in (camera.photograph(now, False), camera.sought(now)):
        points = deproject(take.depth, take.shows(Seen.TARGET), TRUE).astype(np.float64)
        assert len(points) > 200
        own = Rotation.from_euler("XYZ", angles).inv().apply(origin + frame.apply(points) - middle)
        np.testing.assert_allclose((np.abs(own) - half).max(axis=1), 0.0, atol=5e-6)


def test_models_that_changed_are_read_anew(tmp_path: Path) -> None:
    scene, counts = DATA.scene(209), []
    frame, origin = hand_frame(START, scene.assets.panda, OFFICIAL.physics)
    now = Snapshot(START, None, np.append(origin + frame.apply([0.036, 0.0, 0.6]), [0, 0, 0])[None].astype(np.float32))
    for number, size in enumerate(("0.05 0.05 0.05", "0.1 0.1 0.1")):
        urdf = write_box(tmp_path / "box.urdf", size)
        os.utime(urdf, ns=(number, number))
        camera = RayCamera(replace(scene.assets, objects=(urdf,)), OFFICIAL.physics)
        counts.append(int(camera.sought(now).shows(Seen.TARGET).sum()))
    assert counts[1] > 3 * counts[0] > 100


def own_assets(tmp_path: Path, spoil: Callable[[Path], object]) -> SceneAssets:
    """A scene's models, of whose target the visual mesh was spoilt."""
    assets = DATA.scene(209).assets
    folder = tmp_path / "target"
    shutil.copytree(assets.objects[0].parent, folder)
    spoil(folder / "textured_simple.obj")
    return replace(assets, objects=(folder / assets.objects[0].name, *assets.objects[1:]))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (Path.unlink, "not an OBJ file"),
        (lambda path: path.write_text(""), "empty"),
        (lambda path: path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n"), "empty"),
        (lambda path: path.write_text("v 0 0 zero\nf 1 2 3\n"), "not an OBJ file"),
        (lambda path: path.write_text("v 0 0 0\nv 1 0 0\nf 1 2 3\n"), "not there"),
        (lambda path: path.write_text("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n"), "not finite"),
        (lambda path: path.write_bytes(bytes(range(256)) * 4), "empty"),
    ],
)
def test_spoilt_meshes_are_named(tmp_path: Path, spoil: Callable[[Path], object], message: str) -> None:
    with pytest.raises(DataFormatError, match=rf"target/textured_simple\.obj: .*{message}"):
        RayCamera(own_assets(tmp_path, spoil), OFFICIAL.physics)


@pytest.mark.parametrize("body", ["table", "panda", "hand", "objects"])
@pytest.mark.parametrize("text", [None, "", "<robot", "<robot name='r'/>"])
def test_spoilt_models_are_named(tmp_path: Path, body: str, text: str | None) -> None:
    path = tmp_path / "broken.urdf"
    if text is not None:
        path.write_text(text)
    changed: dict[str, Any] = {body: (path,) if body == "objects" else path}
    with pytest.raises(SimulationError, match=r"broken\.urdf"):
        RayCamera(replace(DATA.scene(209).assets, **changed), OFFICIAL.physics)


def test_shapes_that_cannot_be_drawn_are_named(tmp_path: Path) -> None:
    urdf = write_box(tmp_path / "tube.urdf", "1 1 1")
    urdf.write_text(urdf.read_text().replace('<box size="1 1 1"/>', '<cylinder radius="1" length="1"/>'))
    with pytest.raises(HandoverError, match=r"tube\.urdf.*'l6'.*cylinder"):
        RayCamera(replace(DATA.scene(209).assets, objects=(urdf,)), OFFICIAL.physics)
