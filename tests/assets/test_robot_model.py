"""Tests of the Panda with a camera on its hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.assets.robot_model import CAMERA_PANDA_URDF, PANDA_URDF
from handover_marl.config import PandaConfig
from handover_marl.geometry.panda import CAMERA_LINK, HAND_LINK, LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.simulation.bullet.bodies import PandaBody
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf


def joints(client: BulletClient, urdf: Path) -> dict[str, tuple[Any, ...]]:
    """Return PyBullet's data of each link's joint without the indices of the joint and its parent, by link name."""
    body = load_urdf(client, urdf, useFixedBase=True)
    infos = [client.getJointInfo(body, joint) for joint in range(client.getNumJoints(body))]
    return {info[12].decode(): (info[1], info[2], *info[6:16]) for info in infos}


def test_joints_are_those_of_the_plain_panda() -> None:
    client = connect()
    plain, camera = joints(client, PANDA_URDF), joints(client, CAMERA_PANDA_URDF)
    assert camera.pop(CAMERA_LINK)[1] == client.JOINT_FIXED
    assert camera == plain
    assert list(camera) == list(plain), "moving joints keep their order"


def test_camera_pose_equals_handoversims() -> None:
    client, robot = connect(), np.random.default_rng(1).uniform(LOWER_LIMITS, UPPER_LIMITS)
    panda, plain = (PandaBody(client, urdf, PandaConfig()) for urdf in (CAMERA_PANDA_URDF, PANDA_URDF))
    panda.reset_joints(robot.tolist())
    hand, camera = panda.read_link_poses([panda.get_link(HAND_LINK), panda.get_link(CAMERA_LINK)]).astype(np.float64)
    relative = compose(invert_pose(hand), camera)
    np.testing.assert_allclose(relative[:3], [0.036, 0.0, 0.036], atol=1e-6)
    assert abs(relative[3:] @ [-0.5, 0.5, -0.5, 0.5]) == pytest.approx(1.0, abs=1e-6)
    # A Panda without a camera has the same camera pose.
    plain.reset_joints(robot.tolist())
    for pose in (panda.read_camera_pose(), plain.read_camera_pose()):
        np.testing.assert_allclose(pose[:3], camera[:3], atol=1e-6)
        assert abs(pose[3:] @ camera[3:]) == pytest.approx(1.0, abs=1e-6)
