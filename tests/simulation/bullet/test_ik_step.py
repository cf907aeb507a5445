from pathlib import Path

import numpy as np
import pytest

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.geometry.poses import compose, compute_rotation_angle, invert_pose
from handover_marl.simulation.bullet.kinematics import BulletIKStep

DATA = SyntheticDataset()
BASE = np.array([*PandaConfig().base_position, *PandaConfig().base_orientation])
POSE = np.array([0.55, -0.05, 1.45, -0.5, 0.5, 0.5, 0.5])


@pytest.fixture(scope="module")
def kinematics() -> BulletIKStep:
    return BulletIKStep(Path(DATA.panda_urdf), PandaConfig())


@pytest.mark.parametrize("orientation", [None, POSE[3:]])
@pytest.mark.parametrize("steps", [0, 137])
def test_solutions_equal_those_of_the_worlds_robot(
    kinematics: BulletIKStep, orientation: np.ndarray | None, steps: int
) -> None:
    episode = Episode("exact")
    episode.reset(DATA.load_scene(9))
    episode.advance(np.array([0.4, *PandaConfig().start_joints[1:]], dtype=np.float32), steps)
    world = episode.world
    target = [POSE[:3].tolist()] if orientation is None else [POSE[:3].tolist(), orientation.tolist()]
    panda = world._loaded_workcell.panda
    expected = world._client.calculateInverseKinematics(panda.id, panda.hand_link, *target)
    for _ in range(2):
        found = kinematics.solve_step(world.read_joints_float64(), POSE[:3], orientation)
        np.testing.assert_array_equal(found, expected)
        # Another query in between must not change the next solution.
        kinematics.solve_step(world.read_joints_float64(), POSE[:3] + 0.1)
    if steps:
        rounded = kinematics.solve_step(world.read_joints_float64().astype(np.float32), POSE[:3], orientation)
        assert (rounded != expected).any(), "float32 joints are not enough"
    episode.close()


def test_poses_transform_to_the_base_and_back(kinematics: BulletIKStep) -> None:
    inside = kinematics.to_base_frame(POSE.astype(np.float32))
    back = kinematics.to_world_frame(inside)
    for found, expected in ((inside, compose(invert_pose(BASE), POSE)), (back, POSE)):
        np.testing.assert_allclose(found[:3], expected[:3], atol=2e-7)
        assert compute_rotation_angle(found[3:], expected[3:]) < 1e-3
    for pose in (inside, back):
        np.testing.assert_array_equal(pose, pose.astype(np.float32))
