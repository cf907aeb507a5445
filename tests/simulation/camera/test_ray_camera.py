"""Tests of the ray caster's images against those of Bullet's software renderer."""

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

from handover_marl.config import OFFICIAL_CONFIG, PandaConfig, PhysicsConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene, SceneAssets
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError, HandoverError, SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import FINGERTIPS, HAND_LINK, LOWER_LIMITS, PANDA, PANDA_CAMERA, UPPER_LIMITS
from handover_marl.simulation.bullet.rendering import SceneRenderer
from handover_marl.simulation.camera import framebuffer
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import EMPTY_DEPTH, IMAGE_SIZE, NEAR, PINHOLE_MODEL, deproject
from handover_marl.simulation.camera.ray_camera import RayCamera

Array = npt.NDArray[np.float64]

DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
START = np.array(PandaConfig().start_joints, dtype=np.float32)
TARGET_LABELS = (SegmentationLabel.TARGET, SegmentationLabel.HAND)
#: Scenes with five, three and four objects, and with left and right hands.
SCENES = (9, 209, 14)
#: Axes of the camera (right, down, ahead) as columns, and its pinhole (m), in the frame of the hand link.
_AXES, _PINHOLE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), (0.036, 0.0, 0.036)

seeds = st.integers(0, 2**32 - 1)


def hand_frame(robot: npt.NDArray[np.float32], urdf: Path, config: PhysicsConfig) -> tuple[Rotation, Array]:
    """Return the rotation and position (m) of the Panda's hand link in the world."""
    tree = read_tree(urdf)
    origins, turns = (value[0] for value in tree.compute_link_frames(robot[None]))
    link = tree.get_link(HAND_LINK)
    base = Rotation.from_quat(config.panda.base_orientation)
    return base * Rotation.from_matrix(turns[link]), base.apply(origins[link]) + config.panda.base_position


@dataclass(frozen=True, eq=False, repr=False)
class Stand:
    """Scene with both of its renderers, the ray caster and Bullet's."""

    scene: Scene
    rays: RayCamera
    engine: SceneRenderer
    config: PhysicsConfig

    def in_view(self, robot: npt.NDArray[np.float32], places: npt.ArrayLike) -> Array:
        """Return world positions (n, 3) of points given right, down and ahead of the camera."""
        turn, origin = hand_frame(robot, self.scene.assets.panda, self.config)
        return np.array(origin + turn.apply(np.asarray(places) @ _AXES.T + _PINHOLE))

    def thrown(self, rng: np.random.Generator, near: float = 0.0, far: float = 0.6) -> JointSnapshot:
        """Return a random arm pose, with hand and objects `near` to `far` (m) before the camera; bodies may overlap."""
        low, high = np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
        robot = (low + rng.uniform(0.1, 0.9, 9) * (high - low)).astype(np.float32)
        count = len(self.scene.assets.objects) + 1
        ahead = rng.uniform(near, far, (count, 1))
        aside = rng.uniform(-0.7, 0.7, (count, 2)) * np.maximum(np.abs(ahead), 0.05)
        dof = np.c_[self.in_view(robot, np.c_[aside, ahead]), rng.uniform(-np.pi, np.pi, (count, 3))]
        # Nothing may be below the ground, because the ground hides object and hand in whole images only.
        dof[:, 2] = np.maximum(dof[:, 2], 0.3)
        hand = np.concatenate([dof[0], rng.uniform(-0.8, 0.8, 45)])
        return JointSnapshot(robot, hand.astype(np.float32), dof[1:].astype(np.float32))


def make_stand(scene: Scene, config: PhysicsConfig = OFFICIAL_CONFIG.physics) -> Stand:
    return Stand(scene, RayCamera(scene.assets, config), SceneRenderer(scene, config), config)


@pytest.fixture(scope="module")
def stands() -> Iterator[dict[int, Stand]]:
    made = {scene_id: make_stand(DATA.load_scene(scene_id)) for scene_id in SCENES}
    yield made
    for stand in made.values():
        stand.engine.close()


def assert_same_bits(first: CameraImage, second: CameraImage) -> None:
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.segmentation, second.segmentation)


class Agreement:
    """Counts (n, 6) of the pixels on which two renderers agree, by image and segmentation label."""

    def __init__(self) -> None:
        self.both, self.either, self.near = (np.zeros((0, 6), dtype=int) for _ in range(3))

    def add(self, drawn: CameraImage, cast: CameraImage) -> None:
        shown = [(drawn.compute_mask(seen), cast.compute_mask(seen)) for seen in SegmentationLabel]
        near = np.abs(drawn.depth - cast.depth) < 1e-4
        self.both = np.r_[self.both, [[(one & other).sum() for one, other in shown]]]
        self.either = np.r_[self.either, [[(one | other).sum() for one, other in shown]]]
        self.near = np.r_[self.near, [[(one & other & near).sum() for one, other in shown]]]

    def seen(self, *wanted: SegmentationLabel) -> int:
        return int(self.either[:, list(wanted)].sum())

    def check(self, *wanted: SegmentationLabel, least: int = 500, alike: float = 0.999) -> None:
        """Check the agreement on the given labels and on all labels, and that each given label has `least` pixels."""
        for kinds in (wanted, SegmentationLabel):
            both, either, near = (value[:, list(kinds)].sum() for value in (self.both, self.either, self.near))
            assert both >= alike * either
            assert near >= 0.99 * both
        assert min(self.seen(kind) for kind in wanted) >= least


# ------------------------------------------------------------------------------------- comparison with the engine


@pytest.mark.parametrize("scene_id", SCENES)
def test_rays_match_the_engine_for_random_poses(stands: dict[int, Stand], scene_id: int) -> None:
    stand, agreement, rng = stands[scene_id], Agreement(), np.random.default_rng(scene_id)
    for _ in range(7):
        now = stand.thrown(rng)
        agreement.add(stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False))
    agreement.check(*TARGET_LABELS, SegmentationLabel.OTHER_OBJECT, SegmentationLabel.ROBOT, least=2000)
    # Some of the images show the table, and some the ground or nothing.
    assert min(agreement.seen(SegmentationLabel.BACKGROUND), agreement.seen(SegmentationLabel.TABLE)) > 2000


def test_rays_match_the_engine_for_far_objects(stands: dict[int, Stand]) -> None:
    """Both renderers agree up to the far plane and across it; the engine omits triangles far smaller than a pixel."""
    stand, agreement, rng, farthest = stands[9], Agreement(), np.random.default_rng(4), []
    for _ in range(8):
        now = stand.thrown(rng, 1.2, 2.1)
        drawn, cast = stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False)
        agreement.add(drawn, cast)
        farthest.append(cast.depth[cast.segmentation > SegmentationLabel.TABLE].max(initial=0.0))
    agreement.check(*TARGET_LABELS, SegmentationLabel.OTHER_OBJECT, least=200, alike=0.995)
    assert 1.98 < max(farthest) < EMPTY_DEPTH


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_rays_match_the_engine_during_motion(physics: str) -> None:
    """Both renderers agree while the arm moves to where it sees the hand, which appears after 0.4 s."""
    scene, agreement = DATA.load_scene(14), Agreement()
    episode, camera = Episode(physics), RayCamera(scene.assets, OFFICIAL_CONFIG.physics)
    episode.reset(scene)
    goal = START + np.array([0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2, -0.02, -0.01], dtype=np.float32)
    for steps in (1, 499, 200, 200, 200, 100):
        episode.advance(goal, steps)
        agreement.add(
            episode.world.render_wrist_camera(None, False),
            camera.render_wrist_camera(episode.world.read_joint_snapshot(), False),
        )
    agreement.check(*TARGET_LABELS)
    assert episode.steps == 1200
    episode.close()


def grasped(stand: Stand, robot: npt.NDArray[np.float32], place: npt.ArrayLike, turn: list[float]) -> JointSnapshot:
    """Return a snapshot with the target at a pose in the hand link's frame and the hand behind it; all else is far."""
    frame, origin = hand_frame(robot, stand.scene.assets.panda, stand.config)
    points = origin + frame.apply([place, np.add(place, (0.05, 0.0, 0.1))])
    angles = (frame * Rotation.from_euler("XYZ", turn)).as_euler("XYZ")
    objects = np.zeros((len(stand.scene.assets.objects), 6), dtype=np.float32)
    objects[:, :3] = (5.0, 5.0, 1.0)
    objects[0] = np.concatenate([points[0], angles])
    return JointSnapshot(robot, np.concatenate([points[1], np.zeros(48)]).astype(np.float32), objects)


@pytest.mark.parametrize("fingers", [0.0, 0.03])
@pytest.mark.parametrize(
    ("place", "seen"),
    [(FINGERTIPS, True), ((0.16, 0.0, 0.09), True), ((0.036, -0.1, 0.07), True), ((0.03, 0.01, 0.036), False)],
)
def test_rays_match_the_engine_for_a_grasped_object(
    stands: dict[int, Stand], place: tuple[float, ...], seen: bool, fingers: float
) -> None:
    """Both renderers agree on a target between the fingers, across the near plane, or around the camera (invisible)."""
    stand, agreement, robot = stands[209], Agreement(), START.copy()
    robot[7:] = fingers
    for turn in ([0.0, 0.0, 0.0], [0.3, 1.2, -0.5], [1.5, 0.1, 0.7], [-0.5, 0.5, 2.0]):
        now = grasped(stand, robot, place, turn)
        assert_targets_equal_the_whole_image(stand.rays, now)
        agreement.add(stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False))
    agreement.check(*(TARGET_LABELS if seen else [SegmentationLabel.HAND]))
    assert seen == bool(agreement.seen(SegmentationLabel.TARGET))


def test_no_hand_pixels_without_a_hand(stands: dict[int, Stand]) -> None:
    stand, rng = stands[9], np.random.default_rng(3)
    here = stand.thrown(rng)
    gone = here._replace(hand=None)
    with_hand, without = (stand.rays.render_wrist_camera(now, False) for now in (here, gone))
    assert with_hand.compute_mask(SegmentationLabel.HAND).sum() > 100
    assert not without.compute_mask(SegmentationLabel.HAND).any()
    kept = ~with_hand.compute_mask(SegmentationLabel.HAND)
    np.testing.assert_array_equal(without.segmentation[kept], with_hand.segmentation[kept])
    agreement = Agreement()
    agreement.add(stand.engine.render_wrist_camera(gone, False), without)
    agreement.check(SegmentationLabel.TARGET, least=100)
    assert_targets_equal_the_whole_image(stand.rays, gone)
    assert_same_bits(stand.rays.render_wrist_camera(here, False), with_hand)


def test_robot_and_table_stand_where_they_are_configured_to() -> None:
    base = (0.3, -0.3, 0.9), (0.1830127, 0.1830127, 0.6830127, 0.6830127)
    panda = replace(PandaConfig(), base_position=base[0], base_orientation=base[1])
    config = PhysicsConfig(panda=panda, table_position=(0.35, 0.1, -0.1))
    stand, agreement, rng = make_stand(DATA.load_scene(209), config), Agreement(), np.random.default_rng(1)
    for _ in range(4):
        now = stand.thrown(rng)
        agreement.add(stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False))
    agreement.check(SegmentationLabel.TARGET, SegmentationLabel.ROBOT, SegmentationLabel.TABLE)
    stand.engine.close()


def test_objects_of_one_model_have_own_labels() -> None:
    """The target and three other objects of the same model have their own labels at their own positions."""
    scene = DATA.load_scene(209)
    assets = replace(scene.assets, objects=scene.assets.objects[:1] * 4)
    ids = scene.info.object_ids[:1] * 4
    several = replace(scene, assets=assets, info=replace(scene.info, object_ids=ids))
    stand = make_stand(several)
    places = stand.in_view(START, [[-0.3, 0.0, 0.6], [0.3, 0.0, 0.6], [0.0, -0.3, 0.6], [0.0, 0.3, 0.6]])
    now = JointSnapshot(START, None, np.c_[places, np.zeros((4, 3))].astype(np.float32))
    drawn, cast = stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False)
    agreement = Agreement()
    agreement.add(drawn, cast)
    agreement.check(SegmentationLabel.TARGET, SegmentationLabel.OTHER_OBJECT)
    assert cast.compute_mask(SegmentationLabel.TARGET)[:, :100].any()
    assert not cast.compute_mask(SegmentationLabel.TARGET)[:, 100:].any()
    assert cast.compute_mask(SegmentationLabel.OTHER_OBJECT)[:, 160:].any()
    stand.engine.close()


# ------------------------------------------------------------------------------------------ images of the targets


def assert_targets_equal_the_whole_image(rays: RayCamera, now: JointSnapshot) -> CameraImage:
    """Assert that images of targets equal the whole image at their pixels and are empty elsewhere.

    Return the image of the target object and the hand.
    """
    whole, part = rays.render_wrist_camera(now, False), rays.render_targets(now)
    wanted = whole.compute_mask(SegmentationLabel.TARGET) | whole.compute_mask(SegmentationLabel.HAND)
    np.testing.assert_array_equal(part.segmentation, np.where(wanted, whole.segmentation, 0))
    np.testing.assert_array_equal(part.depth, np.where(wanted, whole.depth, EMPTY_DEPTH))
    objects = rays.render_targets(now, with_others=True)
    wanted |= whole.compute_mask(SegmentationLabel.OTHER_OBJECT)
    np.testing.assert_array_equal(objects.segmentation, np.where(wanted, whole.segmentation, 0))
    np.testing.assert_array_equal(objects.depth, np.where(wanted, whole.depth, EMPTY_DEPTH))
    return part


@settings(max_examples=30)
@given(st.sampled_from(SCENES), seeds, st.sampled_from([(0.0, 0.3), (-0.1, 0.6), (0.3, 1.8)]))
def test_targets_equal_those_of_the_whole_image(
    stands: dict[int, Stand], scene_id: int, seed: int, depths: tuple[float, float]
) -> None:
    now = stands[scene_id].thrown(np.random.default_rng(seed), *depths)
    assert_targets_equal_the_whole_image(stands[scene_id].rays, now)


@pytest.mark.parametrize("scene_id", SCENES)
def test_no_pixel_outside_of_the_rectangles_is_visible(
    stands: dict[int, Stand], scene_id: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rays through all pixels give the same images as rays through the rectangles around links."""
    stand, rng = stands[scene_id], np.random.default_rng(scene_id)
    snapshots = [stand.thrown(rng, near=-0.3) for _ in range(8)]
    images = [stand.rays.render_wrist_camera(now, False) for now in snapshots]

    def cover_image(corners: npt.NDArray[np.float32]) -> tuple[npt.NDArray[Any], ...]:
        whole = np.tile([0, IMAGE_SIZE], (len(corners), 1))
        return whole, whole, np.zeros(len(corners), dtype=bool)

    monkeypatch.setattr(framebuffer, "_bound_boxes", cover_image)
    for now, image in zip(snapshots, images, strict=True):
        assert_same_bits(stand.rays.render_wrist_camera(now, False), image)


@settings(max_examples=10)
@given(seeds)
def test_full_occlusion_leaves_no_targets(stands: dict[int, Stand], seed: int) -> None:
    """Target and hand have no pixels where the second object, a gelatin box before the camera, hides them."""
    stand, rng = stands[209], np.random.default_rng(seed)
    now = stand.thrown(rng, 0.8, 1.2)
    now.objects[1:, :3] = stand.in_view(now.robot, [0.0, 0.0, 0.07])
    part = assert_targets_equal_the_whole_image(stand.rays, now)
    behind = stand.rays.render_wrist_camera(now, False).compute_mask(SegmentationLabel.OTHER_OBJECT)
    assert behind.any()
    assert not part.segmentation[behind].any()


def test_image_without_object_and_hand_is_empty(stands: dict[int, Stand]) -> None:
    stand = stands[9]
    now = stand.thrown(np.random.default_rng(0))
    now.objects[0, :3] = now.hand[:3] = stand.in_view(now.robot, [0.0, 0.0, -1.0])  # type: ignore[index]
    part = assert_targets_equal_the_whole_image(stand.rays, now)
    assert not part.segmentation.any()
    assert (part.depth == EMPTY_DEPTH).all()


# --------------------------------------------------------------------------------------------------- whole images


def test_images_do_not_depend_on_earlier_images(stands: dict[int, Stand]) -> None:
    """Images do not depend on earlier ones, although scenes share bodies, which cache their last poses."""
    views = [(stand, stand.thrown(np.random.default_rng(number))) for number in range(3) for stand in stands.values()]
    still = [(stand, now._replace(robot=views[0][1].robot)) for stand, now in views[:3]]
    views += still
    taken = [stand.rays.render_wrist_camera(now, True) for stand, now in views]
    again = [stand.rays.render_wrist_camera(now, True) for stand, now in views[::-1]][::-1]
    for (stand, now), first, second in zip(views, taken, again, strict=True):
        assert_same_bits(first, second)
        np.testing.assert_array_equal(first.rgb, second.rgb)
        stand.rays.render_targets(now)
        assert_same_bits(first, RayCamera(stand.scene.assets, OFFICIAL_CONFIG.physics).render_wrist_camera(now, False))


def test_joint_arrays_may_be_overwritten(stands: dict[int, Stand]) -> None:
    stand, rng = stands[9], np.random.default_rng(8)
    first, second = stand.thrown(rng), stand.thrown(rng)
    expected = stand.rays.render_wrist_camera(second, False)
    held = JointSnapshot(*(value.copy() for value in first if value is not None))
    stand.rays.render_wrist_camera(held, False)
    for value, new in zip(held, second, strict=True):
        value[...] = new  # type: ignore[index]
    assert_same_bits(stand.rays.render_wrist_camera(held, False), expected)


def test_rendering_changes_no_joint(stands: dict[int, Stand]) -> None:
    now = stands[9].thrown(np.random.default_rng(2))
    before = [value.copy() for value in now if value is not None]
    first = stands[9].rays.render_wrist_camera(now, True)
    stands[9].rays.render_targets(now).depth[...] = 0.0
    for value, old in zip(now, before, strict=True):
        np.testing.assert_array_equal(value, old)
    kept = first.depth.copy(), first.segmentation.copy()
    first.depth[...], first.segmentation[...] = 0.0, 0
    again = stands[9].rays.render_wrist_camera(now, True)
    np.testing.assert_array_equal(again.depth, kept[0])
    np.testing.assert_array_equal(again.segmentation, kept[1])


def test_a_panda_without_camera_has_the_same_view(stands: dict[int, Stand]) -> None:
    plain = open_dataset("synthetic", robot=PANDA).load_scene(209)
    assert plain.assets.panda != stands[209].scene.assets.panda
    for seed in range(2):
        now = stands[209].thrown(np.random.default_rng(seed))
        expected = stands[209].rays.render_wrist_camera(now, False)
        assert_same_bits(RayCamera(plain.assets, OFFICIAL_CONFIG.physics).render_wrist_camera(now, False), expected)


def test_colours_change_nothing_and_are_those_of_the_materials(stands: dict[int, Stand]) -> None:
    stand = stands[14]
    now = stand.thrown(np.random.default_rng(5))
    plain, photo = stand.rays.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, True)
    assert plain.rgb is None
    assert photo.rgb is not None
    assert_same_bits(plain, photo)
    assert (photo.rgb.shape, photo.rgb.dtype) == ((224, 224, 3), np.uint8)
    assert (photo.rgb[photo.depth == EMPTY_DEPTH] == 255).all()
    # Every material has one hue; shading darkens it by at most 40 %, and differently on different faces.
    (skin,) = {tuple(color) for surface in stand.rays._hand.surfaces for color in surface.texels.tolist()}
    light = photo.rgb[photo.compute_mask(SegmentationLabel.HAND)] / np.array(skin)
    assert 0.59 < light.min() < 0.75 < light.max() < 1.01
    np.testing.assert_allclose(light, light.mean(axis=1, keepdims=True) * np.ones(3), atol=0.01)
    assert np.ptp(light.mean(axis=1)) > 0.2


def test_image_shapes_and_types(stands: dict[int, Stand]) -> None:
    stand = stands[209]
    now = stand.thrown(np.random.default_rng(6))
    for photo in (stand.rays.render_wrist_camera(now, False), stand.rays.render_targets(now)):
        assert (photo.depth.shape, photo.depth.dtype) == ((224, 224), np.float32)
        assert (photo.segmentation.shape, photo.segmentation.dtype) == ((224, 224), np.uint8)
        assert NEAR <= photo.depth.min() < photo.depth.max() == EMPTY_DEPTH
        assert (photo.depth[photo.segmentation > 0] < EMPTY_DEPTH).all()
        assert set(np.unique(photo.segmentation).tolist()) <= set(SegmentationLabel)


# -------------------------------------------------------------------------------------------------------- models

_CHAIN = "".join(
    f'<link name="l{number}"/><joint name="j{number}" type="{kind}"><parent link="l{number - 1}"/>'
    f'<child link="l{number}"/><axis xyz="{axis}"/></joint>'
    for number, (kind, axis) in enumerate(
        [(kind, axis) for kind in ("prismatic", "continuous") for axis in ("1 0 0", "0 1 0", "0 0 1")], start=1
    )
)


def write_box(path: Path, size: str) -> Path:
    """Write a URDF with the six joints of an object and a box at the end of the chain; return its path."""
    box = f'<visual><geometry><box size="{size}"/></geometry></visual>'
    chain = _CHAIN.replace('<link name="l6"/>', f'<link name="l6">{box}</link>')
    path.write_text(f'<robot name="box"><link name="l0"/>{chain}</robot>')
    return path


@settings(max_examples=15)
@given(seeds)
def test_pinhole_points_are_on_the_surfaces(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Points of a box that are deprojected with the pinhole model lie on the surface of the box."""
    scene, rng = DATA.load_scene(209), np.random.default_rng(seed)
    half = np.array([0.05, 0.08, 0.11])
    urdf = write_box(tmp_path_factory.mktemp("box") / "box.urdf", "0.1 0.16 0.22")
    camera = RayCamera(replace(scene.assets, objects=(urdf,)), OFFICIAL_CONFIG.physics)
    frame, origin = hand_frame(START, scene.assets.panda, OFFICIAL_CONFIG.physics)
    angles = rng.uniform(-np.pi, np.pi, 3)
    middle = origin + frame.apply(np.append(rng.uniform(-0.1, 0.2, 2), 0.45))
    now = JointSnapshot(START, None, np.append(middle, angles)[None].astype(np.float32))
    for take in (camera.render_wrist_camera(now, False), camera.render_targets(now)):
        points = deproject(take.depth, take.compute_mask(SegmentationLabel.TARGET), PINHOLE_MODEL).astype(np.float64)
        assert len(points) > 200
        own = Rotation.from_euler("XYZ", angles).inv().apply(origin + frame.apply(points) - middle)
        np.testing.assert_allclose((np.abs(own) - half).max(axis=1), 0.0, atol=5e-6)


def test_changed_models_are_read_again(tmp_path: Path) -> None:
    scene, counts = DATA.load_scene(209), []
    frame, origin = hand_frame(START, scene.assets.panda, OFFICIAL_CONFIG.physics)
    now = JointSnapshot(
        START, None, np.append(origin + frame.apply([0.036, 0.0, 0.6]), [0, 0, 0])[None].astype(np.float32)
    )
    for number, size in enumerate(("0.05 0.05 0.05", "0.1 0.1 0.1")):
        urdf = write_box(tmp_path / "box.urdf", size)
        os.utime(urdf, ns=(number, number))
        camera = RayCamera(replace(scene.assets, objects=(urdf,)), OFFICIAL_CONFIG.physics)
        counts.append(int(camera.render_targets(now).compute_mask(SegmentationLabel.TARGET).sum()))
    assert counts[1] > 3 * counts[0] > 100


def own_assets(tmp_path: Path, spoil: Callable[[Path], object]) -> SceneAssets:
    """Return the models of a scene with a copy of the target whose visual mesh was damaged by `spoil`."""
    assets = DATA.load_scene(209).assets
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
def test_damaged_meshes_are_reported(tmp_path: Path, spoil: Callable[[Path], object], message: str) -> None:
    with pytest.raises(DataFormatError, match=rf"target/textured_simple\.obj: .*{message}"):
        RayCamera(own_assets(tmp_path, spoil), OFFICIAL_CONFIG.physics)


@pytest.mark.parametrize("body", ["table", "panda", "hand", "objects"])
@pytest.mark.parametrize("text", [None, "", "<robot", "<robot name='r'/>"])
def test_damaged_models_are_reported(tmp_path: Path, body: str, text: str | None) -> None:
    path = tmp_path / "broken.urdf"
    if text is not None:
        path.write_text(text)
    changed: dict[str, Any] = {body: (path,) if body == "objects" else path}
    with pytest.raises(SimulationError, match=r"broken\.urdf"):
        RayCamera(replace(DATA.load_scene(209).assets, **changed), OFFICIAL_CONFIG.physics)


def test_unsupported_shapes_are_reported(tmp_path: Path) -> None:
    urdf = write_box(tmp_path / "tube.urdf", "1 1 1")
    urdf.write_text(urdf.read_text().replace('<box size="1 1 1"/>', '<cylinder radius="1" length="1"/>'))
    with pytest.raises(HandoverError, match=r"tube\.urdf.*'l6'.*cylinder"):
        RayCamera(replace(DATA.load_scene(209).assets, objects=(urdf,)), OFFICIAL_CONFIG.physics)
