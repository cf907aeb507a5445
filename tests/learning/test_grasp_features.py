"""Tests of the features of the known grasp of lowest cost."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.learning.features import count_features, make_features
from handover_marl.receivers import make_policy_context
from tests.givers.test_givers import seen
from tests.learning.grasps import select_grasp

CONTEXT = make_policy_context(SyntheticDataset())


def at_the_grasp(way: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """Return features with the gripper `way` (m) behind the chosen grasp and turned by `turn` (rad)."""
    observation = seen(hand_keypoints=np.full((16, 3), 5.0, np.float32))
    chosen = select_grasp(CONTEXT, observation)
    assert chosen is not None
    turned = Rotation.from_quat(chosen[0][3:])
    place = chosen[0][:3] - turned.apply([0.0, 0.0, way])
    pose = [*place, *(turned * Rotation.from_rotvec([0.0, 0.0, turn])).as_quat()]
    return make_features("receiver", "close", CONTEXT)(observation | {"gripper_pose": np.float32(pose)})


@pytest.mark.parametrize("name", ["grasp", "close"])
def test_number_of_features(name: str) -> None:
    made = make_features("receiver", name, CONTEXT)(seen())
    assert (made.shape, made.dtype) == ((count_features("receiver", name),), np.float32)


def test_proximity_is_one_at_the_grasp_and_decays() -> None:
    np.testing.assert_allclose(at_the_grasp()[:8], [0, 0, 0, 0, 0, 0, 1, 1], atol=2e-3)
    away = at_the_grasp(way=0.03)
    np.testing.assert_allclose(away[:3], [0.0, 0.0, 0.15], atol=2e-3)
    np.testing.assert_allclose(away[6:8], [np.exp(-1.0), 1.0], atol=2e-3)
    np.testing.assert_allclose(at_the_grasp(turn=0.2)[6:8], [1.0, np.exp(-1.0)], atol=5e-3)


def test_other_features_are_fingers_release_and_existence() -> None:
    joints = np.float32([0, 0, 0, -1, 0, 1, 0, 0.04, 0.0])
    some = make_features("receiver", "close", CONTEXT)(seen(robot_joint_position=joints, released=np.float32([1.0])))
    np.testing.assert_allclose(some[8:], [1.0, -1.0, 1.0, 1.0])
    without = replace(CONTEXT, grasps=lambda name: None)
    np.testing.assert_array_equal(make_features("receiver", "close", without)(seen())[[*range(8), 11]], 0.0)
    np.testing.assert_array_equal(make_features("receiver", "grasp", without)(seen())[-8:], 0.0)
