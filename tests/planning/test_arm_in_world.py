"""Tests of arm kinematics in the world frame."""

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.planning.arm_control import ArmInWorld

DATA = SyntheticDataset()
JOINTS = np.array([0.2, 0.1, -0.3, -2.0, 0.4, 2.1, 0.5])


@pytest.fixture(scope="module")
def arm() -> ArmInWorld:
    panda = OFFICIAL_CONFIG.physics.panda
    base = np.array([*panda.base_position, *panda.base_orientation])
    limits = np.array(LOWER_LIMITS[:7]), np.array(UPPER_LIMITS[:7])
    return ArmInWorld(ArmKinematics(read_tree(DATA.panda_urdf)), base, limits)


def test_hand_pose_equals_the_simulation(arm: ArmInWorld) -> None:
    episode = Episode("fast")
    episode.reset(DATA.load_scene(5))
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 500)
    observation = episode.observe()
    episode.close()
    hand = arm.compute_hand_pose(observation["robot_joint_position"][:7].astype(np.float64))
    np.testing.assert_allclose(hand[:3], observation["gripper_pose"][:3], atol=1e-5)
    assert abs(hand[3:] @ observation["gripper_pose"][3:]) == pytest.approx(1.0, abs=1e-6)


def test_velocity_moves_the_hand_as_wanted(arm: ArmInWorld) -> None:
    linear, angular = np.array([0.1, -0.2, 0.05]), np.array([0.2, 0.0, -0.1])
    velocity = arm.compute_joint_velocity(JOINTS, linear, angular, 1.0, 0.05)
    np.testing.assert_allclose(arm.compute_jacobian(JOINTS) @ velocity, [*linear, *angular], atol=0.02)


def test_velocity_respects_joint_limits(arm: ArmInWorld) -> None:
    joints = JOINTS.copy()
    linear = np.array([0.0, 0.3, 0.0])
    free = arm.compute_joint_velocity(joints, linear, np.zeros(3), 0.1, 0.05)
    worst = int(np.argmax(np.abs(free)))
    joints[worst] = arm.limits[1][worst] if free[worst] > 0 else arm.limits[0][worst]
    limited = arm.compute_joint_velocity(joints, linear, np.zeros(3), 0.1, 0.05)
    after = joints + 0.05 * limited
    assert (after >= arm.limits[0] - 1e-9).all()
    assert (after <= arm.limits[1] + 1e-9).all()
