"""Tests of inverse kinematics by PyBullet, which equals that of HandoverSim's simulation."""

import numpy as np
import pytest

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.geometry.rotations import compute_rotation_angles
from handover_marl.simulation.bullet.kinematics import BulletIKSolver, BulletIKStep

DATA = SyntheticDataset()
START = PandaConfig().start_joints
BASE = np.array([*PandaConfig().base_position, *PandaConfig().base_orientation])
POSE = np.array([0.55, -0.05, 1.25, -0.5, 0.5, 0.5, 0.5])


@pytest.mark.parametrize("orientation", [None, POSE[3:]])
def test_single_queries_equal_those_in_the_world(orientation: np.ndarray | None) -> None:
    kinematics, episode = BulletIKStep(DATA.panda_urdf, PandaConfig()), Episode("exact")
    episode.reset(DATA.load_scene(9))
    episode.advance(np.array([0.4, *START[1:]], dtype=np.float32), 57)
    world = episode.world
    target = [POSE[:3].tolist()] if orientation is None else [POSE[:3].tolist(), orientation.tolist()]
    panda = world._loaded_workcell.panda
    expected = world._client.calculateInverseKinematics(panda.id, panda.hand_link, *target)
    for _ in range(2):
        found = kinematics.solve_step(world.read_joints_float64(), POSE[:3], orientation)
        np.testing.assert_array_equal(found, expected)
        # Another query in between must not change the next solution.
        kinematics.solve_step(world.read_joints_float64(), POSE[:3] + 0.1)
    rounded = kinematics.solve_step(world.read_joints_float64().astype(np.float32), POSE[:3], orientation)
    assert (rounded != expected).any(), "float32 joints are not enough"
    solver = BulletIKSolver(DATA.panda_urdf, PandaConfig())
    arm = solver.solve(START, POSE[:3], orientation)
    assert arm is not None
    panda.reset_joints([*arm, 0.04, 0.04])
    pose = episode.observe()["gripper_pose"]
    assert np.linalg.norm(pose[:3] - POSE[:3]) < 2e-3
    assert orientation is None or compute_rotation_angles(pose[3:], orientation) < 0.11
    assert solver.solve(START, (3.0, 0.0, 1.0)) is None
    np.testing.assert_array_equal(solver.solve(START, POSE[:3], orientation), arm)
    episode.close()


def test_poses_transform_to_the_base_and_back() -> None:
    kinematics = BulletIKStep(DATA.panda_urdf, PandaConfig())
    inside = kinematics.to_base_frame(POSE.astype(np.float32))
    back = kinematics.to_world_frame(inside)
    for found, expected in ((inside, compose(invert_pose(BASE), POSE)), (back, POSE)):
        np.testing.assert_allclose(found[:3], expected[:3], atol=2e-7)
        assert compute_rotation_angles(found[3:], expected[3:]) < 1e-3
        np.testing.assert_array_equal(found, found.astype(np.float32))
