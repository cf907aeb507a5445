"""Tests of forward kinematics, Jacobians, reachability and inverse kinematics of the Panda's arm."""

import numpy as np

from handover_marl.assets.shipped import PANDA_URDF
from handover_marl.config import PandaConfig
from handover_marl.geometry.arm import ReachabilityBound
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.geometry.poses import compose
from handover_marl.planning.ik_solvers import compute_pose_error, solve_ik
from handover_marl.simulation.bullet.kinematics import BulletIKSolver
from tests.planning.robots import ARM, LIMITS, TREE, random_joints

HAND = TREE.get_link(HAND_LINK)
STAND = np.array([*PandaConfig().base_position, *PandaConfig().base_orientation])
RANGE = ReachabilityBound(STAND)


def test_frames_and_jacobians_are_those_of_the_model() -> None:
    joints, small = random_joints(0, 50), 1e-6
    origins, rotations = TREE.compute_link_frames(np.concatenate([joints, np.full((50, 2), 0.04)], axis=1))
    numbers = [TREE.get_link(name) for name in ARM.link_names]
    frames, chain = ARM.compute_link_frames(joints), ARM.compute_chain_frames(joints)
    np.testing.assert_allclose(frames.origins.transpose(2, 0, 1), origins[:, numbers], atol=1e-12)
    np.testing.assert_allclose(frames.rotations.transpose(3, 0, 1, 2), rotations[:, numbers], atol=1e-12)
    np.testing.assert_array_equal(chain.origins, frames.origins[:8])
    jacobian = ARM.compute_jacobian(chain)
    for joint in range(7):
        moved = ARM.compute_chain_frames(joints + small * np.eye(7)[joint])
        ends = moved.origins[-1], moved.rotations[-1].transpose(2, 0, 1)
        way = compute_pose_error(chain.origins[-1], chain.rotations[-1], *ends)
        np.testing.assert_allclose(jacobian[:, joint], way / small, atol=1e-4)


def test_inverse_kinematics_comes_back() -> None:
    joints = random_joints(0, 80)
    hand = ARM.compute_chain_frames(joints)
    near = np.clip(joints + np.random.default_rng(0).uniform(-0.05, 0.05, joints.shape), *LIMITS)
    found, solved = solve_ik(ARM, hand.origins[-1].T, hand.rotations[-1].transpose(2, 0, 1), near, LIMITS, 1e-6, 100)
    assert solved.mean() > 0.8  # a query near a limit may fail because of the clamping
    again = ARM.compute_chain_frames(found[solved])
    np.testing.assert_allclose(again.origins[-1], hand.origins[-1][:, solved], atol=2e-6)
    np.testing.assert_allclose(again.rotations[-1], hand.rotations[-1][..., solved], atol=4e-6)
    assert (found >= LIMITS[0]).all()
    assert (found <= LIMITS[1]).all()
    far = np.array([[2.0, 0.0, 0.5], [0.0, 0.0, 3.0]])
    _, solved = solve_ik(ARM, far, np.repeat(np.eye(3)[None], 2, axis=0), random_joints(1, 2), LIMITS, 1e-6, 100)
    assert not solved.any()


def test_no_reachable_pose_is_excluded() -> None:
    joints = np.random.default_rng(0).uniform(-np.pi, np.pi, (2000, 7))
    poses = compose(STAND, TREE.compute_link_poses(np.hstack([joints, np.zeros((2000, 2))]), [HAND])[:, 0])
    assert not RANGE.is_unreachable(poses[:, :3], None, 1e-5, 0.0).any()
    assert not RANGE.is_unreachable(poses[:, :3], poses[:, 3:], 1e-5, 0.0).any()


def test_a_hand_that_points_back_reaches_less() -> None:
    """At 80 cm straight ahead, a hand that points away from the robot is reachable, and one that points back is not."""
    kinematics = BulletIKSolver(PANDA_URDF, PandaConfig())
    position = np.array([0.61, 0.29, 1.15])
    away, back = np.array([-0.7071068, 0.0, 0.0, 0.7071068]), np.array([0.7071068, 0.0, 0.0, 0.7071068])
    assert RANGE.is_unreachable(position, np.stack([away, back]), 2e-3, 0.11).tolist() == [False, True]
    start = PandaConfig().start_joints
    assert kinematics.solve(start, position, away) is not None
    assert kinematics.solve(start, position, back) is None
    kinematics._reachability = ReachabilityBound(STAND + np.array([*(position - STAND[:3]), 0, 0, 0, 0]))
    assert kinematics.solve(start, position, back) is None, "searching finds nothing either"
