"""Tests of the ray caster's images against those of Bullet's software renderer."""

import os
from collections.abc import Iterator
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
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import FINGERTIPS, HAND_LINK, PANDA_CAMERA
from handover_marl.simulation.bullet.rendering import SceneRenderer
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import EMPTY_DEPTH, PINHOLE_MODEL, deproject
from handover_marl.simulation.camera.ray_camera import RayCamera
from tests.simulation.camera.snapshots import draw_snapshot, place_in_view

Array = npt.NDArray[np.float64]

DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
START = np.array(PandaConfig().start_joints, dtype=np.float32)
TARGET_LABELS = (SegmentationLabel.TARGET, SegmentationLabel.HAND)
#: Scenes with five, three and four objects, and with left and right hands.
SCENES = (9, 209, 14)

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
        return place_in_view(self.scene, self.config, robot, places)

    def draw(self, rng: np.random.Generator, near: float = 0.0, far: float = 0.6) -> JointSnapshot:
        """Draw a snapshot; nothing is below the ground, which hides object and hand in whole images only."""
        now = draw_snapshot(self.scene, self.config, rng, nearest=near, farthest=far)
        for dof in (now.hand, *now.objects):
            dof[2] = max(dof[2], 0.3)  # type: ignore[index]
        return now


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


@pytest.mark.slow
@pytest.mark.parametrize("scene_id", SCENES)
def test_rays_match_the_engine_for_random_poses(stands: dict[int, Stand], scene_id: int) -> None:
    stand, agreement, rng = stands[scene_id], Agreement(), np.random.default_rng(scene_id)
    for _ in range(7):
        now = stand.draw(rng)
        agreement.add(stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False))
    agreement.check(*TARGET_LABELS, SegmentationLabel.OTHER_OBJECT, SegmentationLabel.ROBOT, least=2000)
    # Some of the images show the table, and some the ground or nothing.
    assert min(agreement.seen(SegmentationLabel.BACKGROUND), agreement.seen(SegmentationLabel.TABLE)) > 2000


def test_rays_match_the_engine_for_far_objects(stands: dict[int, Stand]) -> None:
    """Both renderers agree up to the far plane and across it; the engine omits triangles far smaller than a pixel."""
    stand, agreement, rng, farthest = stands[9], Agreement(), np.random.default_rng(4), []
    for _ in range(8):
        now = stand.draw(rng, 1.2, 2.1)
        drawn, cast = stand.engine.render_wrist_camera(now, False), stand.rays.render_wrist_camera(now, False)
        agreement.add(drawn, cast)
        farthest.append(cast.depth[cast.segmentation > SegmentationLabel.TABLE].max(initial=0.0))
    agreement.check(*TARGET_LABELS, SegmentationLabel.OTHER_OBJECT, least=200, alike=0.995)
    assert 1.98 < max(farthest) < EMPTY_DEPTH


def grasped(stand: Stand, robot: npt.NDArray[np.float32], place: npt.ArrayLike, turn: list[float]) -> JointSnapshot:
    """Return a snapshot with the target at a pose in the hand link's frame and the hand behind it; all else is far."""
    frame, origin = hand_frame(robot, stand.scene.assets.panda, stand.config)
    points = origin + frame.apply([place, np.add(place, (0.05, 0.0, 0.1))])
    angles = (frame * Rotation.from_euler("XYZ", turn)).as_euler("XYZ")
    objects = np.zeros((len(stand.scene.assets.objects), 6), dtype=np.float32)
    objects[:, :3] = (5.0, 5.0, 1.0)
    objects[0] = np.concatenate([points[0], angles])
    return JointSnapshot(robot, np.concatenate([points[1], np.zeros(48)]).astype(np.float32), objects)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "seen", "fingers"),
    [(FINGERTIPS, True, 0.03), ((0.16, 0.0, 0.09), True, 0.0), ((0.03, 0.01, 0.036), False, 0.03)],
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
    here = stand.draw(rng)
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
        now = stand.draw(rng)
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


@pytest.mark.slow
@settings(max_examples=30)
@given(st.sampled_from(SCENES), seeds, st.sampled_from([(0.0, 0.3), (-0.1, 0.6), (0.3, 1.8)]))
def test_targets_equal_those_of_the_whole_image(
    stands: dict[int, Stand], scene_id: int, seed: int, depths: tuple[float, float]
) -> None:
    now = stands[scene_id].draw(np.random.default_rng(seed), *depths)
    assert_targets_equal_the_whole_image(stands[scene_id].rays, now)


# --------------------------------------------------------------------------------------------------- whole images


@pytest.mark.slow
def test_images_do_not_depend_on_earlier_images(stands: dict[int, Stand]) -> None:
    """Images do not depend on earlier ones, although scenes share bodies, which cache their last poses."""
    views = [(stand, stand.draw(np.random.default_rng(number))) for number in range(3) for stand in stands.values()]
    still = [(stand, now._replace(robot=views[0][1].robot)) for stand, now in views[:3]]
    views += still
    taken = [stand.rays.render_wrist_camera(now, True) for stand, now in views]
    again = [stand.rays.render_wrist_camera(now, True) for stand, now in views[::-1]][::-1]
    for (stand, now), first, second in zip(views, taken, again, strict=True):
        assert_same_bits(first, second)
        np.testing.assert_array_equal(first.rgb, second.rgb)
        stand.rays.render_targets(now)
        assert_same_bits(first, RayCamera(stand.scene.assets, OFFICIAL_CONFIG.physics).render_wrist_camera(now, False))


def test_colours_change_nothing_and_are_those_of_the_materials(stands: dict[int, Stand]) -> None:
    stand = stands[14]
    now = stand.draw(np.random.default_rng(5))
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


@pytest.mark.parametrize("body", ["table", "panda", "hand", "objects"])
@pytest.mark.parametrize("text", [None, "<robot"])
def test_damaged_models_are_reported(tmp_path: Path, body: str, text: str | None) -> None:
    path = tmp_path / "broken.urdf"
    if text is not None:
        path.write_text(text)
    changed: dict[str, Any] = {body: (path,) if body == "objects" else path}
    with pytest.raises(SimulationError, match=r"broken\.urdf"):
        RayCamera(replace(DATA.load_scene(209).assets, **changed), OFFICIAL_CONFIG.physics)
