from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataNotFoundError, ResultsError
from handover_marl.imitation.vision.grasp_labels import GraspLabels, LabelConfig
from handover_marl.imitation.vision.grasp_view_files import ViewSource, read_views, take_views, view_file
from handover_marl.imitation.vision.grasp_views import GraspViews, ViewConfig, ViewMaker, object_pose
from handover_marl.imitation.vision.recorded_hands import recorded_hand
from handover_marl.networks.grasp_losses import belongs, good_grasps
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.policies.context import PolicyContext, context_of
from handover_marl.receivers.reactive.grasps import GraspTrials
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig

pytest.importorskip("embreex")
DATA = open_dataset("synthetic")
SCENE = DATA.scene(9)
# Known grasps only, tried from their places alone: what is tested here is not how well they hold.
QUICK = LabelConfig(receiver=ReactiveConfig(trials=GraspTrials(tilts=(), aside=(), around=(), deeper=())))


@pytest.fixture(scope="module")
def context() -> PolicyContext:
    return context_of(DATA)


@pytest.fixture(scope="module")
def labels(context: PolicyContext) -> GraspLabels:
    return GraspLabels(context, QUICK)


@pytest.fixture(scope="module")
def maker(context: PolicyContext, labels: GraspLabels) -> ViewMaker:
    return ViewMaker(
        context,
        ArmInWorld.of_panda(context.panda_urdf, context.panda),
        labels,
        ViewConfig(objects=64, hands=32, grasps=24),
    )


@pytest.fixture(scope="module")
def views(maker: ViewMaker) -> GraspViews:
    return maker.views(SCENE, 30, np.random.default_rng(0))


def test_views_show_object_and_hand(views: GraspViews) -> None:
    count = len(views.objects)
    assert count > 20
    assert [array.shape[1:] for array in views] == [(64, 3), (32, 3), (), (24, 7), (24,), (3,), (3,), (3,)]
    # Nothing nearer than the near plane is seen, and what is seen is about where the object is.
    assert (views.objects[..., 2] > 0.07).all()
    away = np.linalg.norm(views.objects.astype(float) - views.middle[:, None].astype(float), axis=-1)
    assert away.max() < 0.3
    assert (views.n_hands > 0).mean() > 0.5


def test_grasps_are_where_the_object_is(views: GraspViews) -> None:
    assert (views.quality[:, 0] > 0.1).mean() > 0.5
    assert (np.diff(views.quality.astype(float), axis=1) <= 0.0).all()
    grasps, quality = (torch.from_numpy(array.astype(np.float32)) for array in (views.grasps, views.quality))
    centers = torch.from_numpy(views.objects.astype(np.float32))
    some = belongs(centers, good_grasps(grasps, quality)).flatten(1).any(dim=1)
    assert some[quality[:, 0] > 0.1].float().mean() > 0.8


def test_motion_is_that_of_the_recording(maker: ViewMaker, context: PolicyContext) -> None:
    path = SCENE.object_dof[:, 0, :3].astype(float)
    frame = int(np.argmax(np.linalg.norm(path[500:] - path[:-500], axis=1)))
    joints = np.array(context.panda.start_joints[:7])
    seen = maker.seen(SCENE, [(frame, joints)], np.random.default_rng(0))
    assert len(seen.objects) == 1
    turn = Rotation.from_quat(ArmInWorld.of_panda(context.panda_urdf, context.panda).hand(joints)[3:])
    np.testing.assert_allclose(turn.apply(seen.motion[0]), path[frame + 500] - path[frame], atol=2e-3)
    np.testing.assert_allclose(turn.apply(seen.velocity[0]), (path[frame] - path[frame - 50]) / 0.05, atol=2e-2)


def test_room_beside_the_hand_counts(labels: GraspLabels) -> None:
    last = SCENE.n_frames - 1
    pose, hand = object_pose(SCENE, last), recorded_hand(SCENE, last)
    assert hand is not None
    known = labels.of(SCENE.info.target_name)
    alone, beside = labels.qualities(known, None, pose), labels.qualities(known, hand, pose)
    assert (beside <= alone + 1e-12).all()
    assert (beside < alone).any()
    assert recorded_hand(SCENE, 0) is None or SCENE.hand_first == 0


def test_displaced_grasps_have_room_and_cost_more(labels: GraspLabels) -> None:
    last = SCENE.n_frames - 1
    pose, hand = object_pose(SCENE, last), recorded_hand(SCENE, last)
    known = labels.of(SCENE.info.target_name)
    more = labels.beside(SCENE.info.target_name, hand, pose)
    count, added = len(known.poses), len(more.poses) - len(known.poses)
    assert 0 < added <= labels.config.displaced
    np.testing.assert_array_equal(more.poses[:count], known.poses)
    assert (more.prices[count:] >= labels.config.receiver.grasps.untried).all()
    assert (labels.qualities(more, hand, pose)[count:] > labels.config.worth).all()


def test_files_do_not_depend_on_workers_and_are_taken_once(tmp_path: Path) -> None:
    source = ViewSource("synthetic", count=3, config=ViewConfig(objects=16, hands=8, grasps=4), labels=QUICK)
    scenes = (9, 14)
    for workers in (1, 2):
        take_views(source, scenes, tmp_path / str(workers), workers, progress=False)
    one, two = (read_views(scenes, tmp_path / str(workers)) for workers in (1, 2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)
    kept = view_file(tmp_path / "1", 9)
    before = kept.stat().st_mtime_ns
    take_views(source, scenes, tmp_path / "1", 1, progress=False)
    assert kept.stat().st_mtime_ns == before
    with pytest.raises(ResultsError, match="other arguments"):
        take_views(replace(source, seed=1), scenes, tmp_path / "1", 1, progress=False)
    with pytest.raises(DataNotFoundError, match="no views"):
        read_views((), tmp_path)
