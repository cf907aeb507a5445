import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.arm import ReachabilityBound
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import compose
from handover_marl.simulation.bullet.kinematics import BulletIKSolver

URDF = SyntheticDataset().panda_urdf
TREE = read_tree(URDF)
HAND = [joint.link for joint in TREE.joints].index("panda_hand")
STAND = np.array([*PandaConfig().base_position, *PandaConfig().base_orientation])
RANGE = ReachabilityBound(TREE, HAND, STAND)


def hand_pose(joints: list[float]) -> np.ndarray:
    return compose(STAND, TREE.compute_link_poses(np.array([[*joints, 0.0, 0.0]]), [HAND])[0, 0])


@settings(max_examples=100)
@given(st.lists(st.floats(-np.pi, np.pi), min_size=7, max_size=7))
def test_no_reachable_pose_is_excluded(joints: list[float]) -> None:
    pose = hand_pose(joints)
    assert not RANGE.is_unreachable(pose[:3], None, 1e-5, 0.0)
    assert not RANGE.is_unreachable(pose[:3], pose[3:], 1e-5, 0.0)


def test_a_hand_that_points_back_reaches_less() -> None:
    """At 80 cm straight ahead, a hand that points away from the robot is reachable, and one that points back is not."""
    kinematics = BulletIKSolver(URDF, PandaConfig())
    position = np.array([0.61, 0.29, 1.15])
    away, back = np.array([-0.7071068, 0.0, 0.0, 0.7071068]), np.array([0.7071068, 0.0, 0.0, 0.7071068])
    assert not RANGE.is_unreachable(position, away, 2e-3, 0.11)
    assert RANGE.is_unreachable(position, back, 2e-3, 0.11)
    start = PandaConfig().start_joints
    assert kinematics.solve(start, position, away) is not None
    assert kinematics.solve(start, position, back) is None
    kinematics._reachability = ReachabilityBound(TREE, HAND, STAND + np.array([*(position - STAND[:3]), 0, 0, 0, 0]))
    assert kinematics.solve(start, position, back) is None, "searching finds nothing either"
