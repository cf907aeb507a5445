"""Tests of the synthetic scenes: equality to the bit, statistics, and bodies that do not penetrate in simulation."""

from collections.abc import Iterator

import numpy as np
import pytest

from handover_marl.assets.hand_model import SUBJECTS
from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES, SPLITS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.errors import SceneError
from handover_marl.simulation.bullet.exact_and_fast import ExactWorld
from tests.helpers.equality import hash_scene

DATASET = SyntheticDataset()
#: First digits of the scenes' hashes: they change with the generator's version and with nothing else.
HASHES = {
    **{0: "06dd131ef32dedac", 9: "aef853309b935107", 105: "a13d76f0656255c1", 209: "50354874eb6f409d"},
    **{354: "697bd98a497fc3ea", 499: "2d59ad1e1b6f37b2", 640: "17aac7dd7e361bed", 777: "2ab9a2aa1b9c5364"},
    988: "aaa913eb1143dea9",
}


@pytest.mark.parametrize("scene_id", HASHES)
def test_scenes_equal_their_checksums_and_have_the_statistics_of_recordings(scene_id: int) -> None:
    scene = DATASET.load_scene(scene_id)
    assert hash_scene(scene) == HASHES[scene_id]
    assert (scene.n_frames - 1) % 80 == 40
    assert 65 <= (scene.n_frames - 1) / 40 <= 75
    assert scene.object_dof.dtype == scene.hand_dof.dtype == np.float32
    assert 3 <= len(set(scene.info.object_ids)) == len(scene.info.object_ids) <= 5
    assert scene.info.subject == f"synthetic-subject-{SUBJECTS[scene_id // 100]:02d}"
    assert scene.hand_first is not None
    assert scene.hand_first % 40 == 0
    assert not scene.hand_dof[: scene.hand_first].any()
    # Object and hand move at less than 5 m/s along each axis, and the other objects do not move.
    assert np.abs(np.diff(scene.object_dof[:, 0, :3], axis=0)).max() < 0.005
    assert np.abs(np.diff(scene.hand_dof[scene.hand_first :, :3], axis=0)).max() < 0.005
    assert not np.ptp(scene.object_dof[:, 1:], axis=0).any()
    assert all(path.is_file() for path in scene.urdfs)


def test_numbers_and_official_sizes_of_splits() -> None:
    sizes = {(setup, split): len(DATASET.list_scenes(setup, split)) for setup in SETUPS for split in SPLITS}
    assert sizes == SPLIT_SIZES
    for ask in (DATASET.load_info, DATASET.load_scene, DATASET.find_side):
        with pytest.raises(SceneError, match="0 to 999"):
            ask(1000)


@pytest.fixture(scope="module")
def episode() -> Iterator[Episode]:
    episode = Episode()
    yield episode
    episode.close()


def measure_distance(world: ExactWorld, first: int, second: int) -> float:
    """Return the distance (m) between two bodies: negative where they overlap, inf beyond 5 cm."""
    points = world._client.getClosestPoints(first, second, 0.05)
    return min((point[8] for point in points), default=float("inf"))


def set_frame(episode: Episode, frame: int) -> ExactWorld:
    """Put all bodies at their recorded poses in a frame."""
    scene, world = episode.scene, episode.world
    assert isinstance(world, ExactWorld)
    hand = scene.hand_dof[frame].tolist() if scene.is_hand_present(np.array(frame)) else None
    world._update_hand(hand)
    if world._hand is not None and hand is not None:
        world._hand.reset_joints(hand)
    for body, dof in zip(world._objects, scene.object_dof[frame].tolist(), strict=True):
        body.reset_joints(dof)
    return world


@pytest.mark.slow
@pytest.mark.parametrize("scene_id", range(3, 1000, 142))
def test_bodies_do_not_penetrate_and_the_hand_holds_the_object(episode: Episode, scene_id: int) -> None:
    episode.reset(DATASET.load_scene(scene_id))
    last = episode.scene.n_frames - 1
    for frame in (*range(0, last, 160), last):
        world = set_frame(episode, frame)
        table, (target, *others) = world._loaded_workcell.table_id, (body.id for body in world._objects)
        for moving in (target, *([] if world._hand is None else [world._hand.id])):
            assert measure_distance(world, moving, table) > -0.003, f"frame {frame}"
            for other in others:
                assert measure_distance(world, moving, other) > 0.0, f"frame {frame}"
        for other in others if frame == 0 else []:
            assert -0.003 < measure_distance(world, other, table) < 0.003
            assert all(measure_distance(world, other, another) > 0.0 for another in others if another != other)
    assert world._hand is not None
    points = world._client.getClosestPoints(world._hand.id, target, 0.004)
    # Each digit has nine links; the order is index, middle, little, ring, thumb.
    digits = {(point[3] - 7) // 9 for point in points if point[3] >= 7}
    assert 4 in digits, "the thumb holds"
    assert len(digits) >= 3
    assert min(point[8] for point in points) > -0.012
    # The human hand is more than 3 cm away from the robot in its start pose.
    assert measure_distance(world, world._hand.id, world._loaded_workcell.panda.id) > 0.03
