"""Tests of the ray caster's images against those of Bullet's software renderer."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.config import OFFICIAL_CONFIG, PandaConfig, PhysicsConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.panda import FINGERTIPS, PANDA_CAMERA
from handover_marl.simulation.bullet.rendering import SceneRenderer
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA
from handover_marl.simulation.camera.ray_camera import RayCamera
from tests.simulation.camera.snapshots import draw_snapshot, place_in_view

DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
START = np.array(PandaConfig().start_joints, dtype=np.float32)
TARGET_LABELS = (SegmentationLabel.TARGET, SegmentationLabel.HAND)
#: Scenes with five, three and four objects, and with left and right hands.
SCENES = (9, 209, 14)


@dataclass(frozen=True, eq=False, repr=False)
class Stand:
    """Scene with both of its renderers, the ray caster and Bullet's."""

    scene: Scene
    rays: RayCamera
    engine: SceneRenderer
    config: PhysicsConfig

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


def count_agreement(stand: Stand, snapshots: list[JointSnapshot]) -> npt.NDArray[np.int_]:
    """Return the pixels (3, 6) that either and both renderers show by label, and those of equal depth among both."""
    counts = np.zeros((3, len(SegmentationLabel)), dtype=int)
    for now in snapshots:
        drawn, cast = (one.render(now, False) for one in (stand.engine, stand.rays))
        near = np.abs(drawn.depth - cast.depth) < 1e-4
        for label in SegmentationLabel:
            one, other = drawn.compute_mask(label), cast.compute_mask(label)
            counts[:, label] += [(mask).sum() for mask in (one | other, one & other, one & other & near)]
    return counts


def assert_agree(
    counts: npt.NDArray[np.int_], *wanted: SegmentationLabel, least: int = 500, alike: float = 0.999
) -> None:
    """Check the agreement on the given labels and on all labels, and that each given label has `least` pixels."""
    for labels in (wanted, SegmentationLabel):
        either, both, near = counts[:, list(labels)].sum(axis=1)
        assert both >= alike * either
        assert near >= 0.99 * both
    assert counts[0, list(wanted)].min() >= least


def assert_targets_equal_the_whole_image(rays: RayCamera, now: JointSnapshot) -> None:
    """Check that images of targets equal the whole image at their pixels and are empty elsewhere."""
    whole = rays.render(now, False)
    for labels in (TARGET_LABELS, (*TARGET_LABELS, SegmentationLabel.OTHER_OBJECT)):
        part, wanted = rays.render_targets(now, with_others=len(labels) == 3), np.isin(whole.segmentation, labels)
        np.testing.assert_array_equal(part.segmentation, np.where(wanted, whole.segmentation, 0))
        np.testing.assert_array_equal(part.depth, np.where(wanted, whole.depth, WRIST_CAMERA.empty_depth))


@pytest.mark.slow
@pytest.mark.parametrize("scene_id", SCENES)
def test_rays_match_the_engine_for_random_poses(stands: dict[int, Stand], scene_id: int) -> None:
    stand, rng = stands[scene_id], np.random.default_rng(scene_id)
    snapshots = [stand.draw(rng) for _ in range(4)]
    counts = count_agreement(stand, snapshots)
    assert_agree(counts, *TARGET_LABELS, SegmentationLabel.OTHER_OBJECT, SegmentationLabel.ROBOT, least=1000)
    for now in (*snapshots, stand.draw(rng, -0.1, 0.6), stand.draw(rng, 0.3, 1.8)):
        assert_targets_equal_the_whole_image(stand.rays, now)


@pytest.mark.slow
def test_rays_match_the_engine_for_far_objects(stands: dict[int, Stand]) -> None:
    """Both renderers agree up to the far plane and across it; the engine omits triangles far smaller than a pixel."""
    stand, rng = stands[9], np.random.default_rng(4)
    counts = count_agreement(stand, [stand.draw(rng, 1.2, 2.1) for _ in range(8)])
    assert_agree(counts, *TARGET_LABELS, SegmentationLabel.OTHER_OBJECT, least=200, alike=0.995)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "seen", "fingers"),
    [(FINGERTIPS, True, 0.03), ((0.16, 0.0, 0.09), True, 0.0), ((0.03, 0.01, 0.036), False, 0.03)],
)
def test_rays_match_the_engine_for_a_grasped_object(
    stands: dict[int, Stand], place: tuple[float, ...], seen: bool, fingers: float
) -> None:
    """Both renderers agree on a target between the fingers, across the near plane, or around the camera (invisible)."""
    stand, robot, snapshots = stands[209], START.copy(), []
    robot[7:] = fingers
    # Right, down and ahead of the camera.
    x, y, z = np.subtract(place, WRIST_CAMERA.position)
    points = place_in_view(stand.scene, stand.config, robot, [[y, -x, z], [y, -x - 0.05, z + 0.1]])
    objects = np.tile(np.float32([5.0, 5.0, 1.0, 0.0, 0.0, 0.0]), (len(stand.scene.assets.objects), 1))
    for turn in ([0.3, 1.2, -0.5], [1.5, 0.1, 0.7]):
        own = objects.copy()
        own[0] = np.concatenate([points[0], turn])
        snapshots.append(JointSnapshot(robot, np.append(points[1], np.zeros(48)).astype(np.float32), own))
        assert_targets_equal_the_whole_image(stand.rays, snapshots[-1])
    counts = count_agreement(stand, snapshots)
    assert_agree(counts, *(TARGET_LABELS if seen else [SegmentationLabel.HAND]))
    assert seen == bool(counts[0, SegmentationLabel.TARGET])


def test_no_hand_pixels_without_a_hand(stands: dict[int, Stand]) -> None:
    stand = stands[9]
    here = stand.draw(np.random.default_rng(3))
    gone = here._replace(hand=None)
    with_hand, without = (stand.rays.render(now, False) for now in (here, gone))
    kept = ~with_hand.compute_mask(SegmentationLabel.HAND)
    assert (~kept).sum() > 100
    assert not without.compute_mask(SegmentationLabel.HAND).any()
    np.testing.assert_array_equal(without.segmentation[kept], with_hand.segmentation[kept])
    assert_agree(count_agreement(stand, [gone]), SegmentationLabel.TARGET, least=100)
    assert_targets_equal_the_whole_image(stand.rays, gone)


@pytest.mark.slow
def test_robot_and_table_stand_where_they_are_configured_to() -> None:
    base = (0.3, -0.3, 0.9), (0.1830127, 0.1830127, 0.6830127, 0.6830127)
    panda = replace(PandaConfig(), base_position=base[0], base_orientation=base[1])
    config = PhysicsConfig(panda=panda, table_position=(0.35, 0.1, -0.1))
    stand, rng = make_stand(DATA.load_scene(209), config), np.random.default_rng(1)
    counts = count_agreement(stand, [stand.draw(rng) for _ in range(4)])
    assert_agree(counts, SegmentationLabel.TARGET, SegmentationLabel.ROBOT, SegmentationLabel.TABLE)
    stand.engine.close()


def test_images_do_not_depend_on_earlier_images(stands: dict[int, Stand]) -> None:
    """Images do not depend on earlier ones, although scenes share bodies, which cache their last poses."""
    views = [(stand, stand.draw(np.random.default_rng(number))) for number in range(2) for stand in stands.values()]
    views += [(stand, now._replace(robot=views[0][1].robot)) for stand, now in views[:2]]
    taken = [stand.rays.render(now, False) for stand, now in views]
    again = [stand.rays.render(now, True) for stand, now in views[::-1]][::-1]
    for first, second in zip(taken, again, strict=True):
        assert first.rgb is None
        assert_same_bits(first, second)
