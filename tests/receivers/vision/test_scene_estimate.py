"""Tests of the scene that the receiver `vision` estimates from point clouds, and of views from which it searches."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.robot_clearance import Spheres, compute_open_gripper_clearances
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive.selector import HOME
from handover_marl.receivers.vision.grasp_predictor import GraspPrediction
from handover_marl.receivers.vision.grasp_tracker import GraspTracker
from handover_marl.receivers.vision.receiver import make_vision_reactive_config
from handover_marl.receivers.vision.scene_estimate import (
    HIDDEN_TIMEOUT,
    OBSTACLE_VOXEL_SIZE,
    SEARCH_TIMEOUT,
    PointCloudSceneEstimate,
)
from handover_marl.receivers.vision.view_planner import ViewPlanner
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Array = NDArray[np.float64]

CONTEXT = make_policy_context(open_dataset("synthetic"))
ARM = ArmInWorld.for_panda(CONTEXT.panda_urdf, CONTEXT.panda)
LINK = ARM.compute_hand_pose(HOME)
RNG = np.random.default_rng(0)
OBJECT = np.array([0.6, 0.2, 1.2]) + 0.03 * RNG.normal(size=(200, 3))
OTHERS = np.array([0.5, 0.3, 0.95]) + RNG.uniform(-0.1, 0.1, (300, 3))


def predict(item: Array, hand: Array, velocity: Array, rng: np.random.Generator) -> GraspPrediction:
    return GraspPrediction(np.zeros((0, 7)), np.zeros(0), item.mean(axis=0))


def make_estimate() -> PointCloudSceneEstimate:
    tracker = GraspTracker(predict, 0)
    return PointCloudSceneEstimate(ARM, make_vision_reactive_config(), tracker, ViewPlanner(ARM, np.ones(7)))


def observe(time: float, item: Array, others: Array) -> Observation:
    """Return the observation of a waiting robot that sees points given in the world."""
    points = {"object": item, "hand": np.zeros((0, 3)), "other": others}
    observation: Observation = {
        "time": np.array([time], dtype=np.float32),
        "robot_joint_position": np.array(WAITING_JOINTS, dtype=np.float32),
        "wrist_point_counts": np.array([len(cloud) for cloud in points.values()], dtype=np.float32),
    }
    for name, cloud in points.items():
        padded = np.zeros((1024, 3), dtype=np.float32)
        padded[: len(cloud)] = inverse_transform_points(LINK, cloud) if len(cloud) else cloud
        observation[f"wrist_{name}_points"] = padded
    return observation


def test_visible_points_of_other_objects_are_kept() -> None:
    estimate = make_estimate()
    estimate.update(observe(0.0, OBJECT, np.zeros((0, 3))))
    assert estimate.obstacles is None
    estimate.update(observe(0.05, OBJECT, OTHERS))
    estimate.update(observe(0.10, OBJECT, np.zeros((0, 3))))
    assert estimate.obstacles is not None
    distances = np.linalg.norm(OTHERS[:, None] - estimate.obstacles.centers, axis=-1)
    assert distances.min(axis=0).max() < 1e-4, "points that were visible"
    assert distances.min(axis=1).max() < np.sqrt(3.0) * OBSTACLE_VOXEL_SIZE
    assert len(estimate.obstacles.radii) < len(OTHERS)


@pytest.mark.parametrize(("speed", "patience"), [(0.0, HIDDEN_TIMEOUT), (0.4, SEARCH_TIMEOUT)])
def test_hidden_object_is_expected_for_longer_at_rest(speed: float, patience: float) -> None:
    estimate, nothing = make_estimate(), np.zeros((0, 3))
    for number in range(10):
        estimate.update(observe(0.05 * number, OBJECT + 0.05 * number * speed * np.eye(3)[1], nothing))
    for since, is_lost in ((patience - 0.05, False), (patience + 0.1, True)):
        estimate.update(observe(round(0.45 + since, 3), nothing, nothing))
        assert estimate.is_lost is is_lost
    for time in np.arange(2.5, 3.5, 0.05):
        estimate.update(observe(float(time), nothing, nothing))
        goal = estimate.plan_search()
    assert not np.array_equal(goal, HOME), "the arm searches for the object"


def plan_views(planner: ViewPlanner, times: Array, can_begin: bool = True) -> list[Array]:
    """Return the configurations of an arm that reaches each one within 0.1 s, without repetitions."""
    views, body = [HOME], Spheres(OBJECT, np.full(len(OBJECT), 0.01))
    for time in times:
        view = planner.plan(float(time), views[-1], OBJECT.mean(axis=0), body, can_begin)
        if not np.array_equal(view, views[-1]):
            views.append(view)
    return views


def test_views_look_at_the_object_from_several_directions() -> None:
    _, *views = plan_views(ViewPlanner(ARM, np.ones(7)), np.arange(0.0, 4.0, 0.1))
    poses = ARM.compute_hand_poses(np.array(views))
    for pose in poses:
        right, down, ahead = inverse_transform_points(pose, OBJECT.mean(axis=0)) - WRIST_CAMERA.position
        assert np.hypot(right, down) < 0.01
        assert 0.39 < ahead < 0.51
    assert compute_open_gripper_clearances(poses, Spheres(OBJECT, np.full(len(OBJECT), 0.01))).min() > 0.08
    directions = Rotation.from_quat(poses[:, 3:]).as_matrix()[:, :, 2]
    assert (directions @ directions[0]).min() < np.cos(1.0)


def test_search_begins_after_half_a_second_if_it_may() -> None:
    assert len(plan_views(ViewPlanner(ARM, np.ones(7)), np.arange(0.0, 0.5, 0.1))) == 1
    planner = ViewPlanner(ARM, np.ones(7))
    assert len(plan_views(planner, np.arange(0.0, 4.0, 0.1), can_begin=False)) == 1
    assert len(plan_views(planner, np.arange(4.0, 4.7, 0.1))) == 2
    assert len(plan_views(planner, np.arange(4.7, 8.0, 0.1), can_begin=False)) > 4, "a search that has begun goes on"
    assert len(plan_views(planner, np.arange(8.5, 9.5, 0.1), can_begin=False)) == 1, "a new one does not begin"
