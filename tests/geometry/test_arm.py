"""Tests of forward kinematics, Jacobians and inverse kinematics of the Panda's arm."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.errors import SimulationError
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.planning.ik_solvers import compute_pose_error, solve_ik
from tests.planning.robots import ARM, LIMITS, TREE, random_joints

seeds = st.integers(0, 10_000)


@given(seeds)
def test_frames_are_those_of_the_model(seed: int) -> None:
    joints = random_joints(seed, 3)
    origins, rotations = TREE.compute_link_frames(np.concatenate([joints, np.full((3, 2), 0.04)], axis=1))
    numbers = [[joint.link for joint in TREE.joints].index(name) for name in ARM.link_names]
    frames = ARM.compute_link_frames(joints)
    np.testing.assert_allclose(frames.origins.transpose(2, 0, 1), origins[:, numbers], atol=1e-12)
    np.testing.assert_allclose(frames.rotations.transpose(3, 0, 1, 2), rotations[:, numbers], atol=1e-12)
    chain = ARM.compute_chain_frames(joints)
    np.testing.assert_array_equal(chain.origins, frames.origins[:8])


@given(seeds)
def test_jacobian_is_the_derivative(seed: int) -> None:
    joints, small = random_joints(seed, 2), 1e-6
    jacobian = ARM.compute_jacobian(ARM.compute_chain_frames(joints))
    here = ARM.compute_chain_frames(joints)
    for joint in range(7):
        moved = ARM.compute_chain_frames(joints + small * np.eye(7)[joint])
        way = compute_pose_error(
            here.origins[-1], here.rotations[-1], moved.origins[-1], moved.rotations[-1].transpose(2, 0, 1)
        )
        np.testing.assert_allclose(jacobian[:, joint], way / small, atol=1e-4)


@given(seeds)
def test_inverse_kinematics_comes_back(seed: int) -> None:
    joints = random_joints(seed, 8)
    hand = ARM.compute_chain_frames(joints)
    near = np.clip(joints + np.random.default_rng(seed).uniform(-0.05, 0.05, joints.shape), *LIMITS)
    found, solved = solve_ik(ARM, hand.origins[-1].T, hand.rotations[-1].transpose(2, 0, 1), near, LIMITS, 1e-6, 100)
    assert solved.sum() >= 6  # a query near a limit may fail because of the clamping
    again = ARM.compute_chain_frames(found[solved])
    np.testing.assert_allclose(again.origins[-1], hand.origins[-1][:, solved], atol=2e-6)
    np.testing.assert_allclose(again.rotations[-1], hand.rotations[-1][..., solved], atol=4e-6)
    assert (found >= LIMITS[0]).all()
    assert (found <= LIMITS[1]).all()


def test_unreachable_poses_have_no_solution() -> None:
    far = np.array([[2.0, 0.0, 0.5], [0.0, 0.0, 3.0]])
    _, solved = solve_ik(ARM, far, np.repeat(np.eye(3)[None], 2, axis=0), random_joints(1, 2), LIMITS, 1e-6, 100)
    assert not solved.any()


def test_other_robots_are_refused(fake_data: Path) -> None:
    hand = next((fake_data / "assets").glob("*_right/mano.urdf"))
    with pytest.raises(SimulationError, match="panda_hand"):
        ArmKinematics(read_tree(hand))
