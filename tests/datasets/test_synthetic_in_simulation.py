from collections.abc import Iterator

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.simulation.bullet.exact_world import ExactWorld

pytestmark = pytest.mark.slow

SCENES = range(3, 1000, 71)


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
        world._hand.reset_joints_at_rest(hand)
    for body, dof in zip(world._objects, scene.object_dof[frame].tolist(), strict=True):
        body.reset_joints_at_rest(dof)
    return world


@pytest.mark.parametrize("scene_id", SCENES)
def test_bodies_do_not_penetrate(episode: Episode, scene_id: int) -> None:
    episode.reset(SyntheticDataset().load_scene(scene_id))
    table = set_frame(episode, 0)._loaded_workcell.table_id
    for frame in range(0, episode.scene.n_frames, 80):
        world = set_frame(episode, frame)
        target, *others = (body.id for body in world._objects)
        hand = [] if world._hand is None else [world._hand.id]
        for moving in (target, *hand):
            assert measure_distance(world, moving, table) > -0.003, f"frame {frame}"
            for other in others:
                assert measure_distance(world, moving, other) > 0.0, f"frame {frame}"
        for other in others if frame == 0 else []:
            assert -0.003 < measure_distance(world, other, table) < 0.003
            assert all(measure_distance(world, other, another) > 0.0 for another in others if another != other)


@pytest.mark.parametrize("scene_id", SCENES)
def test_hand_touches_the_object_at_the_handover(episode: Episode, scene_id: int) -> None:
    episode.reset(SyntheticDataset().load_scene(scene_id))
    scene = episode.scene
    world = set_frame(episode, scene.n_frames - 1)
    assert world._hand is not None
    points = world._client.getClosestPoints(world._hand.id, world._objects[0].id, 0.004)
    # Each digit has nine links; the order is index, middle, little, ring, thumb.
    digits = {(point[3] - 7) // 9 for point in points if point[3] >= 7}
    assert 4 in digits, "the thumb holds"
    assert len(digits) >= 3
    assert min(point[8] for point in points) > -0.012
    # The human hand is more than 3 cm away from the robot in its start pose.
    assert measure_distance(world, world._hand.id, world._loaded_workcell.panda.id) > 0.03
