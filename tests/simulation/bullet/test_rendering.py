"""Tests of the wrist camera images of the PyBullet worlds."""

from collections.abc import Iterator

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG, CameraConfig, PandaConfig
from handover_marl.episode.episode import Episode
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from tests.simulation.test_worlds import DATA, load_late_scene

#: The hand is present in this scene from step 50 on.
SCENE = load_late_scene(14, 350)
GOAL = np.array(PandaConfig().start_joints, dtype=np.float32)
GOAL[:7] += [0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2]
STEPS = (40, 300, 300)
FinishedEpisode = tuple[Episode, list[JointSnapshot], list[CameraImage]]


def assert_close(first: CameraImage, second: CameraImage) -> None:
    """Assert that two images are equal except for a few pixels on edges, less than 0.1 % of all."""
    assert (first.segmentation != second.segmentation).mean() < 1e-3
    assert (np.abs(first.depth - second.depth) > 1e-4).mean() < 1e-3


@pytest.fixture(scope="module", params=["exact", "fast"])
def played(request: pytest.FixtureRequest) -> Iterator[FinishedEpisode]:
    """Yield an episode with joint snapshots and images before and after the hand appears.

    After each of these steps, the earlier ones are rendered as well.
    """
    episode = Episode(request.param)
    episode.reset(SCENE)
    moments, photos = [], []
    for steps in STEPS:
        episode.advance(GOAL, steps)
        photos.append(episode.world.render_camera(None, color=True))
        for moment in moments:
            episode.world.render_camera(moment, False)
        moments.append(episode.world.read_joint_snapshot())
    yield episode, moments, photos
    episode.close()


@pytest.mark.slow
def test_images_of_earlier_steps_are_bit_equal_in_any_order(played: FinishedEpisode) -> None:
    episode, moments, photos = played
    assert moments[0].hand is None
    assert not photos[0].compute_mask(SegmentationLabel.HAND).any()
    assert min(photos[2].compute_mask(label).sum() for label in SegmentationLabel) > 50
    for moment, photo in zip(moments, photos, strict=True):
        assert_close(episode.world.render_camera(moment, True), photo)
    first = [episode.world.render_camera(moment, False) for moment in moments]
    again = [episode.world.render_camera(moment, False) for moment in moments[::-1]][::-1]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.segmentation, other.segmentation)
    # PyBullet keeps light and shadows of an image for the next one, unless that has its own.
    episode.render(CameraConfig(width=32, height=24))
    np.testing.assert_array_equal(episode.world.render_camera(None, color=True).rgb, photos[-1].rgb)


@pytest.mark.slow
def test_bodies_of_the_previous_scene_are_removed(played: FinishedEpisode) -> None:
    episode, fresh, scene = played[0], Episode("fast"), DATA.load_scene(209)
    for world in (episode, fresh):
        world.reset(scene)
    photo = fresh.world.render_camera(None, False)
    for moment in (None, episode.world.read_joint_snapshot()):
        assert_close(episode.world.render_camera(moment, False), photo)
    # Table pixels that are deprojected with a pinhole model lie on the top of the table, except for legs and edge.
    gripper = fresh.world.read_state().gripper_pose.astype(np.float64)
    rows, columns = np.nonzero(photo.compute_mask(SegmentationLabel.TABLE))
    depth = photo.depth[rows, columns].astype(np.float64)
    own = np.stack([0.036 - depth * (rows - 111) / 112, depth * (columns - 112) / 112, depth + 0.036], axis=1)
    heights = transform_points(gripper, own)[:, 2]
    top = OFFICIAL_CONFIG.physics.table_position[2] + 0.92
    assert len(rows) > 10_000
    assert heights.max() < top + 1e-4
    assert np.mean(heights > top - 1e-4) > 0.9
    fresh.close()
