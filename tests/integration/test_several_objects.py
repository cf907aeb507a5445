"""Tests of scenes with up to four other objects beside the given one, as DexYCB has them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.config import PandaConfig
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.camera_observations import WristCameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.referee import EpisodeStatus, ReleaseReason
from handover_marl.geometry.poses import transform_points
from handover_marl.receivers import WAITING_JOINTS
from handover_marl.receivers.omg import OmgReceiver
from handover_marl.simulation.bullet.fast_world import FastWorld
from handover_marl.simulation.camera.images import SegmentationLabel
from tests.integration.test_reference import SEVERAL

START = np.array(PandaConfig().start_joints, dtype=np.float32)
PHYSICS = ("exact", "fast")
#: Scenes with one to five objects.
SCENES = (5, 7, 44, 50, 108, 146, 205, 999)
STACK = 205


@pytest.mark.parametrize("scene_id", SCENES)
def test_the_given_object_comes_first(several_objects: OfficialDataset, scene_id: int) -> None:
    cache = several_objects.data_dir / "dex-ycb-cache"
    meta = json.loads((cache / f"meta_{scene_id:03d}.json").read_text())
    with np.load(cache / f"pose_{scene_id:03d}.npz") as archive:
        recorded = archive["pose_y"]
    scene = several_objects.load_scene(scene_id)
    ids, given = meta["ycb_ids"], meta["ycb_grasp_ind"]
    assert scene.info.object_ids == (ids[given], *ids[:given], *ids[given + 1 :])
    assert len(scene.assets.objects) == len(ids)
    order = [ids.index(number) for number in scene.info.object_ids]
    np.testing.assert_array_equal(scene.object_dof[:, :, :2], recorded[:, order, :2])
    np.testing.assert_array_equal(scene.object_dof[:, :, 3:], recorded[:, order, 3:])


@pytest.mark.slow
@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("scene_id", SCENES)
def test_all_of_them_are_observed(several_objects: OfficialDataset, scene_id: int, physics: str) -> None:
    scene = several_objects.load_scene(scene_id)
    n = len(scene.info.object_ids)
    episode = Episode(physics)
    episode.reset(scene)
    episode.advance(START, 100)
    seen = episode.observe()
    episode.close()
    assert seen["object_mask"].tolist() == [1] * n + [0] * (len(seen["object_mask"]) - n)
    assert tuple(seen["object_classes"][:n]) == scene.info.object_ids
    # The motors of exact physics follow the recording, and lag a little behind moving objects.
    np.testing.assert_allclose(seen["object_poses"][:n, :3], scene.object_dof[100, :, :3], atol=5e-3)


@pytest.mark.parametrize("physics", PHYSICS)
def test_held_objects_pass_through_each_other(several_objects: OfficialDataset, physics: str) -> None:
    """Before the release, objects do not collide with each other, so that they can be at the same position."""
    scene = several_objects.load_scene(STACK)
    still = np.repeat(scene.object_dof[:1], scene.n_frames, axis=0)
    still[:, 1:, :3] = still[:, :1, :3]
    episode = Episode(physics)
    episode.reset(replace(scene, object_dof=still))
    episode.advance(START, 500)
    reached = episode.world.read_object_joints()
    episode.close()
    np.testing.assert_allclose(reached, still[0], atol=1e-3)


def stacked(scene: Scene) -> tuple[Scene, float]:
    """Return the scene, moved so that the given object ends above another one, and that one's world z (m)."""
    dof, hand = scene.object_dof.copy(), scene.hand_dof.copy()
    offset = dof[-1, 1, :3] - dof[-1, 0, :3]
    # This is more than half the heights of cracker box and sugar box together; the held box stays upright.
    offset[2] += 0.30
    dof[:, 0, :3] += offset
    hand[np.any(hand != 0, axis=1), :3] += offset
    return replace(scene, object_dof=dof, hand_dof=hand), float(dof[-1, 1, 2])


@pytest.mark.slow
@pytest.mark.parametrize("physics", PHYSICS)
def test_an_object_that_falls_on_another_one_is_dropped(several_objects: OfficialDataset, physics: str) -> None:
    scene, lower = stacked(several_objects.load_scene(STACK))
    episode = Episode(physics)
    episode.reset(scene)
    episode.advance(START, scene.n_frames)
    let_go = NO_DEVIATION.copy()
    let_go[-1] = 1.0
    assert episode.status == EpisodeStatus.RUNNING
    episode.advance(START, 1000, let_go)
    assert episode.release_reason is ReleaseReason.VOLUNTARY
    assert episode.status == EpisodeStatus.OBJECT_DROP
    height = float(episode.observe()["object_poses"][0, 2])
    # The object did not reach the table, because the other object is below it.
    assert height > lower + 0.05
    assert episode.contacts.object_supported
    episode.close()


def replay(episode: Episode, actions: np.ndarray) -> None:
    """Play actions, and the last one for 20 more steps, or until the episode ends."""
    for action in [*actions, *[actions[-1]] * 20]:
        if not episode.status:
            episode.advance(action, 1)


@pytest.mark.slow
def test_the_others_sleep_until_the_arm_comes(several_objects: OfficialDataset, recordings: Path) -> None:
    scene = several_objects.load_scene(108)
    with np.load(recordings / "multi" / "multi_scene108_knock.npz") as archive:
        actions = archive["action"]
    both = [Episode(physics) for physics in PHYSICS]
    for episode in both:
        episode.reset(scene)
    for action in actions[:50]:
        both[1].advance(action, 1)
    world = both[1].world
    assert isinstance(world, FastWorld)
    assert not any(item.is_awake for item in world._objects)
    replay(both[0], actions)
    replay(both[1], actions[50:])
    assert any(item.is_awake for item in world._objects), "the arm sweeps over the table"
    exact, fast = (episode.world.read_object_joints() for episode in both)
    moved = np.abs(exact - scene.object_dof[-1])[:, :3].max(axis=1)
    # Objects that were not pushed end at the same pose to 1 mm; those that tumbled may end up to 5 cm apart.
    np.testing.assert_allclose(fast[moved < 1e-3], exact[moved < 1e-3], atol=1e-3)
    assert (moved > 0.02).any(), "something was pushed"
    np.testing.assert_allclose(fast[:, :3], exact[:, :3], atol=0.05)
    for episode in both:
        episode.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", SEVERAL)
def test_fast_physics_ends_the_recordings_alike(several_objects: OfficialDataset, recordings: Path, name: str) -> None:
    with np.load(recordings / "multi" / f"{name}.npz") as archive:
        recorded = {key: archive[key] for key in ("action", "scene_id", "steps", "status")}
    episode = Episode("fast")
    episode.reset(several_objects.load_scene(int(recorded["scene_id"])))
    replay(episode, recorded["action"])
    assert episode.status == recorded["status"]
    # The end of a fall of a third of a second may differ by some steps.
    assert abs(episode.steps - int(recorded["steps"])) <= 10
    episode.close()


def planned_way(dataset: OfficialDataset, scene: Scene) -> np.ndarray:
    """Return the world positions (w, 3) of the hand at the waypoints of the plan (m)."""
    episode = Episode("fast")
    episode.reset(scene)
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 3000)
    seen = episode.observe()
    episode.close()
    receiver = receivers.make("omg", dataset)
    assert isinstance(receiver, OmgReceiver)
    receiver.reset()
    receiver.act(seen)
    assert receiver.plan is not None
    hand = receiver.arm.compute_chain_frames(receiver.plan.trajectory).origins[-1].T
    return transform_points(receiver.world_from_base, hand)


@pytest.mark.slow
def test_plans_go_round_the_other_objects(several_objects: OfficialDataset) -> None:
    scene = several_objects.load_scene(STACK)
    away = scene.object_dof.copy()
    away[:, 1:, :3] = (0.0, 1.2, 0.0)
    free = planned_way(several_objects, replace(scene, object_dof=away))
    # A box is put on the path of the hand, far from the object that the hand is to grasp.
    place = free[len(free) // 2]
    assert np.linalg.norm(place - scene.object_dof[-1, 0, :3]) > 0.2, "not the object itself"
    blocked = away.copy()
    blocked[:, 1, :3] = place
    round_it = planned_way(several_objects, replace(scene, object_dof=blocked))
    assert np.linalg.norm(free - place, axis=1).min() < 1e-6
    assert np.linalg.norm(round_it - place, axis=1).min() > 0.05


@pytest.mark.slow
def test_the_wrist_camera_separates_them(several_objects: OfficialDataset) -> None:
    """In a view over the table, both renderers label the other objects separately from the given one."""
    pytest.importorskip("embreex")
    scene = several_objects.load_scene(108)
    over_the_table = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.9, 0.785, 0.04, 0.04], dtype=np.float32)
    views = {}
    for renderer in ("bullet", "rays"):
        episode = Episode("exact", wrist_camera=WristCameraConfig(renderer=renderer))
        episode.reset(scene)
        episode.advance(over_the_table, 700)
        views[renderer] = episode.capture_wrist_camera()
        episode.close()
    drawn, cast = (view.segmentation for view in views.values())
    assert (drawn == SegmentationLabel.OTHER_OBJECT).sum() > 300
    assert (drawn == cast).mean() > 0.999
    same = (drawn == SegmentationLabel.OTHER_OBJECT) & (cast == SegmentationLabel.OTHER_OBJECT)
    assert same.sum() > 0.99 * (drawn == SegmentationLabel.OTHER_OBJECT).sum()
    # The point cloud of the given object has no points of the other objects.
    assert len(views["bullet"].object_points) == (drawn == SegmentationLabel.TARGET).sum()
