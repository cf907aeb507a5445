"""Tests of scenes with up to four other objects beside the given one, as DexYCB has them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG, PandaConfig
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.referee import EpisodeStatus, ReleaseReason
from handover_marl.simulation.bullet.exact_and_fast import FastWorld
from handover_marl.simulation.camera.images import SegmentationLabel
from tests.integration.test_reference import SEVERAL

START = np.array(PandaConfig().start_joints, dtype=np.float32)
PHYSICS = ("exact", "fast")
#: Scenes with one, five and four objects.
SCENES = (50, 108, 205)
STACK = 205


def shorten(scene: Scene, steps: int) -> Scene:
    """Return the last steps of a scene, in which the hand holds out the object."""
    motion = {"object_dof": scene.object_dof[-steps:], "hand_dof": scene.hand_dof[-steps:]}
    return replace(scene, **motion, hand_first=0, hand_last=steps - 1)


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
    episode = Episode("fast")
    episode.reset(scene)
    episode.advance(START, 100)
    seen, n = episode.observe(), len(ids)
    episode.close()
    assert seen["object_mask"].tolist() == [1] * n + [0] * (len(seen["object_mask"]) - n)
    assert tuple(seen["object_classes"][:n]) == scene.info.object_ids
    # Motors follow the recording, and lag a little behind moving objects.
    np.testing.assert_allclose(seen["object_poses"][:n, :3], scene.object_dof[100, :, :3], atol=5e-3)


@pytest.mark.parametrize("physics", PHYSICS)
def test_an_object_that_falls_on_another_one_is_dropped(several_objects: OfficialDataset, physics: str) -> None:
    scene = shorten(several_objects.load_scene(STACK), 100)
    dof, hand = scene.object_dof.copy(), scene.hand_dof.copy()
    offset = dof[-1, 1, :3] - dof[-1, 0, :3]
    # This is more than half the heights of cracker box and sugar box together; the held box stays upright.
    offset[2] += 0.30
    dof[:, 0, :3] += offset
    hand[:, :3] += offset
    episode = Episode(physics)
    episode.reset(replace(scene, object_dof=dof, hand_dof=hand))
    episode.advance(START, 100)
    let_go = NO_DEVIATION.copy()
    let_go[-1] = 1.0
    assert episode.status == EpisodeStatus.RUNNING
    episode.advance(START, 1000, let_go)
    assert episode.release_reason is ReleaseReason.VOLUNTARY
    assert episode.status == EpisodeStatus.OBJECT_DROP
    # The object did not reach the table, because the other object is below it.
    assert float(episode.observe()["object_poses"][0, 2]) > float(dof[-1, 1, 2]) + 0.05
    assert episode.contacts.object_supported
    episode.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", SEVERAL[-2:])
def test_fast_physics_ends_the_recordings_alike(several_objects: OfficialDataset, recordings: Path, name: str) -> None:
    """Objects sleep until the arm comes; those that were not pushed end as in the recording, others near it."""
    with np.load(recordings / "multi" / f"{name}.npz") as archive:
        recorded = dict(archive)
    episode = Episode("fast")
    episode.reset(several_objects.load_scene(int(recorded["scene_id"])))
    world = episode.world
    assert isinstance(world, FastWorld)
    awake = []
    for action in [*recorded["action"], *recorded["action"][-1:].repeat(20, axis=0)]:
        if not episode.status:
            episode.advance(action, 1)
            awake.append(sum(item.is_awake for item in world._objects))
    assert awake[49] == 0
    assert max(awake) > 0, "the arm sweeps over the table"
    assert episode.status == recorded["status"]
    # The end of a fall of a third of a second may differ by some steps.
    assert abs(episode.steps - int(recorded["steps"])) <= 10
    exact, fast = recorded["object_dof_position"][-1], world.read_joint_snapshot().objects
    is_still = np.abs(exact - recorded["object_dof_position"][-20])[:, :3].max(axis=1) < 1e-4
    is_still &= np.abs(exact - recorded["object_dof_position"][0])[:, :3].max(axis=1) < 1e-3
    assert is_still.any()
    np.testing.assert_allclose(fast[is_still], exact[is_still], atol=1e-3)
    np.testing.assert_allclose(fast[1:, :3], exact[1:, :3], atol=0.05)
    episode.close()


def test_the_wrist_camera_separates_them(several_objects: OfficialDataset) -> None:
    """In a view over the table, both renderers label the other objects separately from the given one."""
    pytest.importorskip("embreex")
    from handover_marl.simulation.camera.ray_camera import RayCamera

    scene, panda = several_objects.load_scene(108), OFFICIAL_CONFIG.physics.panda
    over_the_table = (0.0, -0.3, 0.0, -2.2, 0.0, 2.9, 0.785, 0.04, 0.04)
    physics = replace(OFFICIAL_CONFIG.physics, panda=replace(panda, start_joints=over_the_table))
    episode = Episode("exact", replace(OFFICIAL_CONFIG, physics=physics))
    episode.reset(scene)
    view = episode.capture_wrist_camera()
    cast = RayCamera(scene.assets, physics).render(episode.world.read_joint_snapshot(), color=False)
    episode.close()
    is_other = view.segmentation == SegmentationLabel.OTHER_OBJECT
    assert is_other.sum() > 300
    assert (view.segmentation == cast.segmentation).mean() > 0.999
    assert (cast.segmentation[is_other] == SegmentationLabel.OTHER_OBJECT).mean() > 0.99
    # The point cloud of the given object has no points of the other objects.
    assert len(view.object_points) == (view.segmentation == SegmentationLabel.TARGET).sum()
