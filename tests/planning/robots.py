"""Panda of the synthetic scenes, for tests of planning."""

import numpy as np

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.planning.arm_control import ArmInWorld

TREE = read_tree(SyntheticDataset().panda_urdf)
ARM = ArmKinematics(TREE)
START = np.array(WAITING_JOINTS[:7])
LIMITS = np.array(LOWER_LIMITS[:7]) + 0.2, np.array(UPPER_LIMITS[:7]) - 0.2
BASE = np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068])
IN_WORLD = ArmInWorld(ARM, BASE, LIMITS)


def random_joints(seed: int, count: int) -> np.ndarray:
    """Return random arm joint positions (count, 7) within the limits (rad)."""
    return np.random.default_rng(seed).uniform(*LIMITS, (count, 7))
