from pathlib import Path

import numpy as np
import pytest

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.models.poses import compose, inverse, rotation_angle
from handover_marl.sim.bullet.engine_kinematics import EngineKinematics

DATA = SyntheticDataset()
BASE = np.array([*PandaConfig().base_position, *PandaConfig().base_orientation])
POSE = np.array([0.55, -0.05, 1.45, -0.5, 0.5, 0.5, 0.5])


@pytest.fixture(scope="module")
def kinematics() -> EngineKinematics:
    return EngineKinematics(Path(DATA.panda_urdf), PandaConfig())


@pytest.mark.parametrize("orientation", [None, POSE[3:]])
@pytest.mark.parametrize("steps", [0, 137])
def test_answers_are_those_of_the_robot_in_its_world(
    kinematics: EngineKinematics, orientation: np.ndarray | None, steps: int
) -> None:
    episode = Episode("exact")
    episode.reset(DATA.scene(9))
    episode.advance(np.array([0.4, *PandaConfig().start_joints[1:]], dtype=np.float32), steps)
    world = episode.world
    target = [POSE[:3].tolist()] if orientation is None else [POSE[:3].tolist(), orientation.tolist()]
    expected = world._client.calculateInverseKinematics(world._panda.id, world._panda.hand_link, *target)
    for _ in range(2):
        found = kinematics.step_towards(world.exact_joints(), POSE[:3], orientation)
        np.testing.assert_array_equal(found, expected)
        # Another question in between.
        kinematics.step_towards(world.exact_joints(), POSE[:3] + 0.1)
    if steps:
        rounded = kinematics.step_towards(world.exact_joints().astype(np.float32), POSE[:3], orientation)
        assert (rounded != expected).any(), "float32 joints are not enough"
    episode.close()


def test_poses_go_to_the_base_and_back_in_single_precision(kinematics: EngineKinematics) -> None:
    inside = kinematics.in_base(POSE.astype(np.float32))
    back = kinematics.in_world(inside)
    for found, expected in ((inside, compose(inverse(BASE), POSE)), (back, POSE)):
        np.testing.assert_allclose(found[:3], expected[:3], atol=2e-7)
        assert rotation_angle(found[3:], expected[3:]) < 1e-3
    for pose in (inside, back):
        np.testing.assert_array_equal(pose, pose.astype(np.float32))
