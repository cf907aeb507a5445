"""The wrist camera's pictures as worlds hand them out."""

from collections.abc import Iterator

import numpy as np
import pytest

from handover_marl.config import OFFICIAL, PandaConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.models.poses import compose_point
from handover_marl.sim.bullet.wrist_view import seen_bodies
from handover_marl.sim.camera.optics import NEAR, NOTHING
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.world import Snapshot

DATA = open_dataset("synthetic", robot="panda_camera")
#: With a hand from the 400th millisecond on.
SCENE = DATA.scene(14)
GOAL = np.array(PandaConfig().start_joints, dtype=np.float32)
GOAL[:7] += [0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2]
STEPS = (350, 350, 350)


def assert_close(first: Photo, second: Photo) -> None:
    """The same but for pixels on edges."""
    assert (first.segmentation != second.segmentation).mean() < 1e-3
    assert (np.abs(first.depth - second.depth) > 1e-4).mean() < 1e-3


@pytest.fixture(scope="module", params=["exact", "fast"])
def played(request: pytest.FixtureRequest) -> Iterator[tuple[Episode, list[Snapshot], list[Photo]]]:
    """An episode and what was seen at some of its moments, before and after the hand came."""
    episode = Episode(request.param)
    episode.reset(SCENE)
    moments, photos = [], []
    for steps in STEPS:
        episode.advance(GOAL, steps)
        moments.append(episode.world.snapshot())
        photos.append(episode.world.photograph(color=True))
    yield episode, moments, photos
    episode.close()


Played = tuple[Episode, list[Snapshot], list[Photo]]


def test_pictures_have_their_form(played: Played) -> None:
    for photo in played[2]:
        assert (photo.depth.shape, photo.depth.dtype) == ((224, 224), np.float32)
        assert (photo.segmentation.shape, photo.segmentation.dtype) == ((224, 224), np.uint8)
        assert photo.rgb is not None
        assert (photo.rgb.shape, photo.rgb.dtype) == ((224, 224, 3), np.uint8)
        assert NEAR <= photo.depth.min() < photo.depth.max() <= NOTHING
        assert (photo.depth[photo.segmentation > 0] < NOTHING).all()
        assert photo.rgb.std() > 10


def test_everything_is_seen_by_its_name(played: Played) -> None:
    """The camera looks at fingers, table, objects, and at the hand once it is there."""
    before, _, after = played[2]
    assert played[1][0].hand is None
    assert not before.shows(Seen.HAND).any()
    for seen in Seen:
        assert after.shows(seen).sum() > 50, seen.name


def test_colours_are_drawn_when_they_are_asked_for(played: Played) -> None:
    episode, _, photos = played
    plain = episode.world.photograph(color=False)
    assert plain.rgb is None
    np.testing.assert_array_equal(plain.depth, photos[-1].depth)
    np.testing.assert_array_equal(plain.segmentation, photos[-1].segmentation)


def test_earlier_moments_look_as_they_looked(played: Played) -> None:
    """In any order, with and without a hand, and the present one stays what it is."""
    episode, moments, photos = played
    for number in (0, 2, 1, 0, 1, 2):
        assert_close(episode.world.photograph(True, moments[number]), photos[number])
    np.testing.assert_array_equal(episode.world.photograph(False).depth, photos[-1].depth)
    assert not np.array_equal(photos[0].depth, photos[-1].depth)


def test_an_earlier_moment_is_the_same_to_the_bit_however_often_it_is_drawn(played: Played) -> None:
    episode, moments, _ = played
    first = [episode.world.photograph(False, moment) for moment in moments]
    again = [episode.world.photograph(False, moment) for moment in moments[::-1]][::-1]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.segmentation, other.segmentation)


@pytest.mark.parametrize("played", ["exact", "fast"], indirect=True)
def test_looking_changes_nothing_of_what_follows(played: Played, request: pytest.FixtureRequest) -> None:
    """Not a bit of it, whether somebody looks at now or at then."""
    physics = request.node.callspec.params["played"]
    blind = Episode(physics)
    blind.reset(SCENE)
    blind.advance(GOAL, sum(STEPS[:1]))
    seen = [blind.world.snapshot()]
    for steps in STEPS[1:]:
        blind.advance(GOAL, steps)
        seen.append(blind.world.snapshot())
    for expected, now in zip(seen, played[1], strict=True):
        for one, other in zip(expected, now, strict=True):
            np.testing.assert_array_equal(one, other)
    blind.close()


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_bodies_of_the_scene_before_are_gone(physics: str) -> None:
    episode, fresh, scenes = Episode(physics), Episode(physics), (SCENE, DATA.scene(209))
    for scene in scenes:
        episode.reset(scene)
        episode.world.photograph(False, Snapshot(GOAL, scene.hand_dof[-1], scene.object_dof[-1]))
    fresh.reset(scenes[1])
    photo = fresh.world.photograph(False)
    for at in (None, episode.world.snapshot()):
        assert_close(episode.world.photograph(False, at), photo)
    episode.close()
    fresh.close()


def test_the_first_object_is_the_target() -> None:
    everything = {4: Seen.TABLE, 5: Seen.ROBOT, 9: Seen.TARGET, 7: Seen.OTHER_OBJECT, 8: Seen.OTHER_OBJECT}
    assert seen_bodies(4, 5, [9, 7, 8], None) == everything
    assert seen_bodies(4, 5, [9, 7, 8], 0) == {**everything, 0: Seen.HAND}
    assert seen_bodies(1, 2, [3], None) == {1: Seen.TABLE, 2: Seen.ROBOT, 3: Seen.TARGET}


def test_the_table_is_seen_where_it_is() -> None:
    """Its top lies flat where the pinhole of the hand's frame puts what the pixels show."""
    episode = Episode("fast")
    episode.reset(DATA.scene(209))
    photo, gripper = episode.world.photograph(False), episode.world.state().gripper_pose.astype(np.float64)
    rows, columns = np.nonzero(photo.shows(Seen.TABLE))
    depth = photo.depth[rows, columns].astype(np.float64)
    own = np.stack([0.036 - depth * (rows - 111) / 112, depth * (columns - 112) / 112, depth + 0.036], axis=1)
    heights = compose_point(gripper, own)[:, 2]
    top = OFFICIAL.physics.table_position[2] + 0.92
    assert len(rows) > 10_000
    assert heights.max() < top + 1e-4
    # The rest of it are its legs and its edge.
    assert np.mean(heights > top - 1e-4) > 0.9
    episode.close()
