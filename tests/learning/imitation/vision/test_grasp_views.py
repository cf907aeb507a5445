from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataNotFoundError
from handover_marl.learning.imitation.samples import get_samples_path
from handover_marl.learning.imitation.vision.grasp_labels import GraspLabelConfig, GraspLabeller
from handover_marl.learning.imitation.vision.views import (
    GraspViewConfig,
    GraspViews,
    ViewRenderer,
    generate_views,
    read_hand_spheres,
    read_object_pose,
)
from handover_marl.learning.networks.grasp_losses import find_enclosed_centers, grasp_targets_from_poses
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.policies.policy import PolicyContext, make_policy_context
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig

pytest.importorskip("embreex")
DATA = open_dataset("synthetic")
SCENE = DATA.load_scene(9)
# Validate only known grasps, without tilts and offsets, because these tests do not check how well grasps hold.
QUICK = GraspLabelConfig(
    receiver=ReactiveConfig(
        preparation=GraspPreparationConfig(tilts=(), lateral_offsets=(), release_offsets=(), advances=())
    )
)


@pytest.fixture(scope="module")
def context() -> PolicyContext:
    return make_policy_context(DATA)


@pytest.fixture(scope="module")
def labels(context: PolicyContext) -> GraspLabeller:
    return GraspLabeller(context, QUICK)


@pytest.fixture(scope="module")
def maker() -> ViewRenderer:
    return ViewRenderer(
        GraspViewConfig("synthetic", count=30, n_object_points=64, max_hand_points=32, max_grasps=24, labels=QUICK)
    )


@pytest.fixture(scope="module")
def views(maker: ViewRenderer) -> GraspViews:
    return maker.render_scene(9)


@pytest.mark.slow
def test_views_contain_object_and_hand(views: GraspViews) -> None:
    count = len(views.object_points)
    assert count > 20
    assert [array.shape[1:] for array in views] == [(64, 3), (32, 3), (), (24, 7), (24,), (3,), (3,), (3,)]
    # No point is nearer than the near plane, and all points are near the object.
    assert (views.object_points[..., 2] > 0.07).all()
    away = np.linalg.norm(views.object_points.astype(float) - views.object_center[:, None].astype(float), axis=-1)
    assert away.max() < 0.3
    assert (views.n_hand_points > 0).mean() > 0.5


def test_grasps_enclose_the_object(views: GraspViews) -> None:
    assert (views.quality[:, 0] > 0.1).mean() > 0.5
    assert (np.diff(views.quality.astype(float), axis=1) <= 0.0).all()
    grasps, quality = (torch.from_numpy(array.astype(np.float32)) for array in (views.grasps, views.quality))
    centers = torch.from_numpy(views.object_points.astype(np.float32))
    some = find_enclosed_centers(centers, grasp_targets_from_poses(grasps, quality)).flatten(1).any(dim=1)
    assert some[quality[:, 0] > 0.1].float().mean() > 0.8


def test_motion_is_the_recorded_one(maker: ViewRenderer, context: PolicyContext) -> None:
    path = SCENE.object_dof[:, 0, :3].astype(float)
    frame = int(np.argmax(np.linalg.norm(path[500:] - path[:-500], axis=1)))
    joints = np.array(context.panda.start_joints[:7])
    seen = maker.render(SCENE, [(maker.label_frames(SCENE, [frame])[frame], joints)], np.random.default_rng(0))
    assert len(seen.object_points) == 1
    turn = Rotation.from_quat(ArmInWorld.for_panda(context.panda_urdf, context.panda).compute_hand_pose(joints)[3:])
    np.testing.assert_allclose(turn.apply(seen.object_motion[0]), path[frame + 500] - path[frame], atol=2e-3)
    np.testing.assert_allclose(turn.apply(seen.object_velocity[0]), (path[frame] - path[frame - 50]) / 0.05, atol=2e-2)


def test_hand_lowers_the_quality_of_grasps(labels: GraspLabeller) -> None:
    last = SCENE.n_frames - 1
    pose, hand = read_object_pose(SCENE, last), read_hand_spheres(SCENE, last)
    assert hand is not None
    known = labels.load_grasps(SCENE.info.target_name)
    alone, beside = labels.compute_qualities(known, None, pose), labels.compute_qualities(known, hand, pose)
    assert (beside <= alone + 1e-12).all()
    assert (beside < alone).any()
    assert read_hand_spheres(SCENE, 0) is None or SCENE.hand_first == 0


def test_offset_grasps_are_clear_of_the_hand_and_cost_more(labels: GraspLabeller) -> None:
    last = SCENE.n_frames - 1
    pose, hand = read_object_pose(SCENE, last), read_hand_spheres(SCENE, last)
    known = labels.load_grasps(SCENE.info.target_name)
    more = labels.load_grasps_near_hand(SCENE.info.target_name, hand, pose)
    count, added = len(known.poses), len(more.poses) - len(known.poses)
    assert 0 < added <= labels.config.max_offset_grasps
    np.testing.assert_array_equal(more.poses[:count], known.poses)
    assert (more.costs[count:] >= labels.config.receiver.selection.offset_cost).all()
    assert (labels.compute_qualities(more, hand, pose)[count:] > labels.config.min_quality).all()


@pytest.mark.slow
def test_files_do_not_depend_on_workers_and_are_kept(tmp_path: Path) -> None:
    source = GraspViewConfig("synthetic", count=3, n_object_points=16, max_hand_points=8, max_grasps=4, labels=QUICK)
    scenes = (9, 14)
    one, two = (generate_views(source, scenes, tmp_path / str(workers), workers) for workers in (1, 2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)
    kept = get_samples_path(tmp_path / "1", 9)
    before = kept.stat().st_mtime_ns
    generate_views(source, scenes, tmp_path / "1", 1)
    assert kept.stat().st_mtime_ns == before
    with pytest.raises(DataNotFoundError, match="a training needs samples, got none"):
        generate_views(source, (), tmp_path, 1)
