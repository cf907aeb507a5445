"""Kinematics where the arm stands."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.config import OFFICIAL
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.models.arm import Arm
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import LOWER_LIMITS, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.planning.arm_in_world import ArmInWorld

DATA = SyntheticDataset()
JOINTS = np.array([0.2, 0.1, -0.3, -2.0, 0.4, 2.1, 0.5])


@pytest.fixture(scope="module")
def arm() -> ArmInWorld:
    panda = OFFICIAL.physics.panda
    base = np.array([*panda.base_position, *panda.base_orientation])
    limits = np.array(LOWER_LIMITS[:7]), np.array(UPPER_LIMITS[:7])
    return ArmInWorld(Arm(read_tree(DATA.panda_urdf)), base, limits)


def test_the_hand_is_where_the_simulator_has_it(arm: ArmInWorld) -> None:
    episode = Episode("fast")
    episode.reset(DATA.scene(5))
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 500)
    observation = episode.observe()
    episode.close()
    hand = arm.hand(observation["robot_joint_position"][:7].astype(np.float64))
    np.testing.assert_allclose(hand[:3], observation["gripper_pose"][:3], atol=1e-5)
    assert abs(hand[3:] @ observation["gripper_pose"][3:]) == pytest.approx(1.0, abs=1e-6)


def test_the_jacobian_is_the_derivative(arm: ArmInWorld) -> None:
    jacobian, step = arm.jacobian(JOINTS), 1e-6
    before = arm.hand(JOINTS)
    for joint in range(7):
        after = arm.hand(JOINTS + step * np.eye(7)[joint])
        turn = (Rotation.from_quat(after[3:]) * Rotation.from_quat(before[3:]).inv()).as_rotvec()
        np.testing.assert_allclose(jacobian[:3, joint], (after[:3] - before[:3]) / step, atol=1e-5)
        np.testing.assert_allclose(jacobian[3:, joint], turn / step, atol=1e-5)


def test_inverse_kinematics_finds_the_way_back(arm: ArmInWorld) -> None:
    targets = JOINTS + np.array([[0.0] * 7, [0.3, 0.1, 0.0, 0.2, 0.0, -0.2, 0.4]])
    found, reached = arm.solve(arm.hands(targets), np.tile(JOINTS, (2, 1)), 20, 1e-6)
    assert reached.all()
    np.testing.assert_allclose(arm.hands(found)[:, :3], arm.hands(targets)[:, :3], atol=1e-5)


def test_links_begin_at_the_base_and_end_before_the_hand(arm: ArmInWorld) -> None:
    origins, turns = (found[0] for found in arm.frames(JOINTS[None]))
    np.testing.assert_allclose(origins[0], [0.61, -0.5, 0.875 + 0.333], atol=1e-6)
    np.testing.assert_allclose(origins[-1] + 0.107 * turns[-1, :, 2], arm.hand(JOINTS)[:3], atol=1e-6)


def test_velocities_move_the_hand_as_wanted(arm: ArmInWorld) -> None:
    linear, angular = np.array([0.1, -0.2, 0.05]), np.array([0.2, 0.0, -0.1])
    velocity = arm.velocity(JOINTS, linear, angular, 1.0, 0.05)
    np.testing.assert_allclose(arm.jacobian(JOINTS) @ velocity, [*linear, *angular], atol=0.02)


def test_joints_at_their_limits_stay_there(arm: ArmInWorld) -> None:
    joints = JOINTS.copy()
    linear = np.array([0.0, 0.3, 0.0])
    free = arm.velocity(joints, linear, np.zeros(3), 0.1, 0.05)
    worst = int(np.argmax(np.abs(free)))
    joints[worst] = arm.limits[1][worst] if free[worst] > 0 else arm.limits[0][worst]
    held = arm.velocity(joints, linear, np.zeros(3), 0.1, 0.05)
    soon = joints + 0.05 * held
    assert (soon >= arm.limits[0] - 1e-9).all()
    assert (soon <= arm.limits[1] + 1e-9).all()
