"""Tests of the scene that the receiver `vision` estimates from point clouds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from handover_marl.datasets import open_dataset
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.planning.arm_control import ArmInWorld
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
    return PointCloudSceneEstimate(ARM, make_vision_reactive_config(), tracker)


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


@pytest.mark.parametrize("others", [np.zeros((0, 3)), OTHERS])
def test_hidden_object_at_rest_is_expected_for_longer_beside_others(others: Array) -> None:
    estimate, nothing = make_estimate(), np.zeros((0, 3))
    for number in range(10):
        estimate.update(observe(0.05 * number, OBJECT, others))
    patience = HIDDEN_TIMEOUT if len(others) else SEARCH_TIMEOUT
    for since, is_lost in ((patience - 0.05, False), (patience + 0.1, True)):
        estimate.update(observe(round(0.45 + since, 3), nothing, others))
        assert estimate.is_lost is is_lost
