from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.robot_model import PANDA_URDF as PANDA
from handover_marl.config import PandaConfig
from handover_marl.datasets import OfficialDataset
from handover_marl.episode.episode import Episode
from handover_marl.geometry.poses import compute_rotation_angle
from handover_marl.simulation.bullet.kinematics import BulletIKSolver
from tests.fake_layout import SCENES

START = PandaConfig().start_joints
FORWARD = np.array([-0.5, 0.5, 0.5, 0.5])


@pytest.mark.parametrize("orientation", [None, FORWARD])
def test_solutions_match_the_worlds_hand_pose(fake_data: Path, orientation: np.ndarray | None) -> None:
    """Solutions are right for a model whose centres of mass are off its link frames and that has additional links."""
    goal = np.array([0.55, 0.05, 1.25])
    arm = BulletIKSolver(PANDA, PandaConfig()).solve(START, goal, orientation)
    assert arm is not None
    episode = Episode("exact")
    episode.reset(OfficialDataset(fake_data).load_scene(SCENES[0].scene_id))
    episode.world._loaded_workcell.panda.reset_joints([*arm, 0.04, 0.04])
    pose = episode.observe()["gripper_pose"]
    assert np.linalg.norm(pose[:3] - goal) < 2e-3
    if orientation is not None:
        assert compute_rotation_angle(pose[3:], orientation) < 0.11


def test_no_solution_out_of_reach() -> None:
    assert BulletIKSolver(PANDA, PandaConfig()).solve(START, (3.0, 0.0, 1.0)) is None


def test_solutions_do_not_depend_on_earlier_queries() -> None:
    used, fresh = (BulletIKSolver(PANDA, PandaConfig()) for _ in range(2))
    used.solve(START, (0.4, 0.1, 1.4))
    np.testing.assert_array_equal(used.solve(START, (0.5, 0.1, 1.2)), fresh.solve(START, (0.5, 0.1, 1.2)))
