from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.robot_model import PANDA_URDF as PANDA
from handover_marl.config import PandaConfig
from handover_marl.datasets import OfficialDataset
from handover_marl.episode.episode import Episode
from handover_marl.models.poses import rotation_angle
from handover_marl.sim.bullet.kinematics import PandaKinematics
from tests.fake_layout import SCENES

START = PandaConfig().start_joints
FORWARD = np.array([-0.5, 0.5, 0.5, 0.5])


@pytest.mark.parametrize("orientation", [None, FORWARD])
def test_the_solution_is_where_the_world_sees_the_hand(fake_data: Path, orientation: np.ndarray | None) -> None:
    """The model's links have centres of mass away from their frames, and more links than the official one."""
    goal = np.array([0.55, 0.05, 1.25])
    arm = PandaKinematics(PANDA, PandaConfig()).solve(START, goal, orientation)
    assert arm is not None
    episode = Episode("exact")
    episode.reset(OfficialDataset(fake_data).scene(SCENES[0].scene_id))
    episode.world._panda.place([*arm, 0.04, 0.04])
    pose = episode.observe()["gripper_pose"]
    assert np.linalg.norm(pose[:3] - goal) < 2e-3
    if orientation is not None:
        assert rotation_angle(pose[3:], orientation) < 0.11


def test_no_solution_out_of_reach() -> None:
    assert PandaKinematics(PANDA, PandaConfig()).solve(START, (3.0, 0.0, 1.0)) is None


def test_answers_do_not_depend_on_earlier_questions() -> None:
    used, fresh = (PandaKinematics(PANDA, PandaConfig()) for _ in range(2))
    used.solve(START, (0.4, 0.1, 1.4))
    np.testing.assert_array_equal(used.solve(START, (0.5, 0.1, 1.2)), fresh.solve(START, (0.5, 0.1, 1.2)))
