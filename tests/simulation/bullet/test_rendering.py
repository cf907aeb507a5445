"""Tests of the wrist camera images of the PyBullet worlds."""

from collections.abc import Iterator

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG, CameraConfig, PandaConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.bullet import rendering
from handover_marl.simulation.bullet.exact_world import ExactWorld
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel

DATA = open_dataset("synthetic", robot="panda_camera")
#: The hand is present in this scene from 0.4 s on.
SCENE = DATA.load_scene(14)
GOAL = np.array(PandaConfig().start_joints, dtype=np.float32)
GOAL[:7] += [0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2]
STEPS = (350, 350, 350)


def assert_close(first: CameraImage, second: CameraImage) -> None:
    """Assert that two images are equal except for a few pixels on edges, less than 0.1 % of all."""
    assert (first.segmentation != second.segmentation).mean() < 1e-3
    assert (np.abs(first.depth - second.depth) > 1e-4).mean() < 1e-3


@pytest.fixture(scope="module", params=["exact", "fast"])
def played(request: pytest.FixtureRequest) -> Iterator[tuple[Episode, list[JointSnapshot], list[CameraImage]]]:
    """Yield an episode with joint snapshots and images, before (step 350) and after (700, 1050) the hand appears.

    After each of these steps, the earlier ones are rendered as well.
    """
    episode = Episode(request.param)
    episode.reset(SCENE)
    moments, photos = [], []
    for steps in STEPS:
        episode.advance(GOAL, steps)
        photos.append(episode.world.render_wrist_camera(None, color=True))
        for moment in moments:
            episode.world.render_wrist_camera(moment, False)
        moments.append(episode.world.read_joint_snapshot())
    yield episode, moments, photos
    episode.close()


FinishedEpisode = tuple[Episode, list[JointSnapshot], list[CameraImage]]


def test_all_labels_occur(played: FinishedEpisode) -> None:
    """Every label occurs once the hand is present, and the label of the hand does not occur before."""
    before, _, after = played[2]
    assert played[1][0].hand is None
    assert not before.compute_mask(SegmentationLabel.HAND).any()
    for seen in SegmentationLabel:
        assert after.compute_mask(seen).sum() > 50, seen.name


def test_overview_images_do_not_change_colours(played: FinishedEpisode) -> None:
    """PyBullet keeps light and shadows of an image for the next one, unless that has its own."""
    episode, _, photos = played
    episode.render(CameraConfig())
    np.testing.assert_array_equal(episode.world.render_wrist_camera(None, color=True).rgb, photos[-1].rgb)


def test_images_of_earlier_steps_are_bit_equal_in_any_order(played: FinishedEpisode) -> None:
    episode, moments, photos = played
    for moment, photo in zip(moments, photos, strict=True):
        assert_close(episode.world.render_wrist_camera(moment, True), photo)
    first = [episode.world.render_wrist_camera(moment, False) for moment in moments]
    again = [episode.world.render_wrist_camera(moment, False) for moment in moments[::-1]][::-1]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.segmentation, other.segmentation)


@pytest.mark.slow
def test_bodies_of_the_previous_scene_are_removed() -> None:
    episode, fresh, scenes = Episode("fast"), Episode("fast"), (SCENE, DATA.load_scene(209))
    for scene in scenes:
        episode.reset(scene)
        episode.world.render_wrist_camera(JointSnapshot(GOAL, scene.hand_dof[-1], scene.object_dof[-1]), False)
    fresh.reset(scenes[1])
    photo = fresh.world.render_wrist_camera(None, False)
    for at in (None, episode.world.read_joint_snapshot()):
        assert_close(episode.world.render_wrist_camera(at, False), photo)
    episode.close()
    fresh.close()


def test_the_first_object_is_the_target(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[dict[int, SegmentationLabel]] = []
    monkeypatch.setattr(rendering, "_label_pixels", lambda numbers, labels: found.append(labels) or numbers)
    episode = Episode("exact")
    episode.reset(DATA.load_scene(86))
    world = episode.world
    assert isinstance(world, ExactWorld)
    world.render_wrist_camera(None, False)
    target, *others = (body.id for body in world._objects)
    assert others
    expected = {
        world._loaded_workcell.table_id: SegmentationLabel.TABLE,
        world._loaded_workcell.panda.id: SegmentationLabel.ROBOT,
        target: SegmentationLabel.TARGET,
        **dict.fromkeys(others, SegmentationLabel.OTHER_OBJECT),
    }
    if world._hand is not None:
        expected[world._hand.id] = SegmentationLabel.HAND
    assert found == [expected]
    episode.close()


def test_table_points_are_on_the_table() -> None:
    """Table pixels that are deprojected with a pinhole model lie on the top of the table, except for legs and edge."""
    episode = Episode("fast")
    episode.reset(DATA.load_scene(209))
    photo, gripper = (
        episode.world.render_wrist_camera(None, False),
        episode.world.read_state().gripper_pose.astype(np.float64),
    )
    rows, columns = np.nonzero(photo.compute_mask(SegmentationLabel.TABLE))
    depth = photo.depth[rows, columns].astype(np.float64)
    own = np.stack([0.036 - depth * (rows - 111) / 112, depth * (columns - 112) / 112, depth + 0.036], axis=1)
    heights = transform_points(gripper, own)[:, 2]
    top = OFFICIAL_CONFIG.physics.table_position[2] + 0.92
    assert len(rows) > 10_000
    assert heights.max() < top + 1e-4
    # The other points are on the legs and the edge.
    assert np.mean(heights > top - 1e-4) > 0.9
    episode.close()
