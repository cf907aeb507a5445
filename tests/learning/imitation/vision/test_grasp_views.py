"""Tests of rendered views with good grasps: geometry, qualities of grasps, and files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataNotFoundError
from handover_marl.learning.imitation.run import generate_samples, get_samples_path, join_samples
from handover_marl.learning.imitation.vision.training import find_enclosed_centers, grasp_targets_from_poses
from handover_marl.learning.imitation.vision.views import (
    MAX_OFFSET_GRASPS,
    MIN_QUALITY,
    GraspViews,
    ViewRenderer,
    read_hand_spheres,
    read_object_pose,
)
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.policies.policy import make_policy_context
from tests.learning.training.scripts import QUICK_REACTIVE

pytestmark = pytest.mark.slow

pytest.importorskip("embreex")
DATA = open_dataset("synthetic")
SCENE = DATA.load_scene(9)
LAST = SCENE.n_frames - 1


@pytest.fixture(scope="module")
def renderer() -> ViewRenderer:
    return ViewRenderer(DATA, 12, 0, QUICK_REACTIVE)


def test_views_contain_object_hand_and_grasps_that_enclose_the_object(renderer: ViewRenderer) -> None:
    views = renderer.render_scene(9)
    assert len(views.object_points) > 8
    assert [array.shape[1:] for array in views] == [(256, 3), (64, 3), (), (96, 7), (96,), (3,), (3,), (3,)]
    # No point is nearer than the near plane, and all points are near the object.
    assert (views.object_points[..., 2] > 0.07).all()
    away = np.linalg.norm(views.object_points.astype(float) - views.object_center[:, None].astype(float), axis=-1)
    assert away.max() < 0.3
    assert (views.n_hand_points > 0).mean() > 0.5
    assert (views.quality[:, 0] > 0.1).mean() > 0.5
    assert (np.diff(views.quality.astype(float), axis=1) <= 0.0).all()
    grasps, quality = (torch.from_numpy(array.astype(np.float32)) for array in (views.grasps, views.quality))
    centers = torch.from_numpy(views.object_points.astype(np.float32))
    some = find_enclosed_centers(centers, grasp_targets_from_poses(grasps, quality)).flatten(1).any(dim=1)
    assert some[quality[:, 0] > 0.1].float().mean() > 0.8


def test_motion_is_the_recorded_one(renderer: ViewRenderer) -> None:
    context = make_policy_context(DATA)
    path = SCENE.object_dof[:, 0, :3].astype(float)
    frame = int(np.argmax(np.linalg.norm(path[500:] - path[:-500], axis=1)))
    joints = np.array(context.panda.start_joints[:7])
    seen = renderer.render(SCENE, [(renderer.label_frames(SCENE, [frame])[frame], joints)], np.random.default_rng(0))
    turn = Rotation.from_quat(ArmInWorld.for_panda(context.panda_urdf, context.panda).compute_hand_pose(joints)[3:])
    np.testing.assert_allclose(turn.apply(seen.object_motion[0]), path[frame + 500] - path[frame], atol=2e-3)
    np.testing.assert_allclose(turn.apply(seen.object_velocity[0]), (path[frame] - path[frame - 50]) / 0.05, atol=2e-2)


def test_hand_lowers_qualities_and_offset_grasps_are_clear_of_it(renderer: ViewRenderer) -> None:
    name, pose, hand = SCENE.info.target_name, read_object_pose(SCENE, LAST), read_hand_spheres(SCENE, LAST)
    known, more = (renderer.load_grasps(name, spheres, pose) for spheres in (None, hand))
    alone, beside = (renderer.compute_qualities(known, spheres, pose) for spheres in (None, hand))
    assert (beside <= alone + 1e-12).all()
    assert (beside < alone).any()
    count, added = len(known.poses), len(more.poses) - len(known.poses)
    assert 0 < added <= MAX_OFFSET_GRASPS
    np.testing.assert_array_equal(more.poses[:count], known.poses)
    assert (more.costs[count:] >= QUICK_REACTIVE.selection.offset_cost).all()
    assert (renderer.compute_qualities(more, hand, pose)[count:] > MIN_QUALITY).all()


def test_files_do_not_depend_on_other_scenes_and_are_kept(tmp_path: Path) -> None:
    def make_renderer() -> Callable[[int], GraspViews]:
        return ViewRenderer(DATA, 2, 0, QUICK_REACTIVE).render_scene

    def load_views(scenes: tuple[int, ...]) -> GraspViews:
        return join_samples(generate_samples(GraspViews, tmp_path, scenes, make_renderer, "rendering", 1))

    reverse = list(map(make_renderer(), (8, 9)))
    for part, *parts in zip(load_views((9, 8)), *reversed(reverse), strict=True):
        np.testing.assert_array_equal(part, np.concatenate(parts))
    kept = get_samples_path(tmp_path, 9)
    before = kept.stat().st_mtime_ns
    load_views((9, 8))
    assert kept.stat().st_mtime_ns == before
    with pytest.raises(DataNotFoundError, match="a training needs samples, got none"):
        load_views(())
