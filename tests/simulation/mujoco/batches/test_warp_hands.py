"""Tests of hands and contact sensors on tensors, which agree with those on arrays. They need no MuJoCo Warp."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo")
pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.config import HandConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.arrays import make_tensor_factory, to_numpy
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.simulation.mujoco.batches.simulation import HandKinematics
from handover_marl.simulation.mujoco.batches.warp_worlds import HandBatch
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.quaternions import WXYZ
from handover_marl.simulation.reference_tracking import (
    BodyTrajectory,
    ReferenceMotion,
    list_hand_motors,
    select_keypoint_links,
    track_references,
)

SCENES = [SyntheticDataset().load_scene(number) for number in (209, 5, 31)]
COUNT = len(SCENES)
TENSORS = make_tensor_factory("cpu")
ROWS = TENSORS.arange(COUNT)


def test_hands_move_as_alone() -> None:
    hands = HandBatch(COUNT, HandConfig(), TENSORS)
    singles = []
    for row, scene in enumerate(SCENES):
        start = ReferenceMotion(scene.object_dof[:1], scene.hand_dof[:1], np.array([row != 1]))
        singles.append(BodyTrajectory(list_hand_motors(HandConfig()), start.hand[0] if row != 1 else None))
        hands.reset(row, scene.assets.hand, start.hand[0] if row != 1 else None)
    for first, taken in ((300, [60, 60, 60]), (360, [60, 20, 0]), (420, [60, 60, 60])):
        part = slice(first, first + 60)
        present = np.ones((COUNT, 60), dtype=bool)
        present[1, :30], present[2, 20:40] = False, False
        motions = [
            ReferenceMotion(scene.object_dof[part], scene.hand_dof[part], own)
            for scene, own in zip(SCENES, present, strict=True)
        ]
        targets = TENSORS.asarray([motion.hand for motion in motions])
        joints = hands.track(ROWS, targets, TENSORS.asarray(present))
        hands.store(ROWS, joints, TENSORS.asarray(present), TENSORS.asarray(taken))
        keypoints = to_numpy(hands.compute_keypoints(ROWS))
        for row, (single, motion) in enumerate(zip(singles, motions, strict=True)):
            if taken[row] == 0:
                continue
            last = taken[row] - 1
            track_references([(single, motion.hand[: last + 1], motion.hand_present[: last + 1])])
            assert bool(hands.present[row]) == single.is_present_after(last)
            if single.is_present_after(last):
                np.testing.assert_allclose(hands.joints[row], single.get_joints(last), atol=1e-12)
                tree = read_tree(SCENES[row].assets.hand)
                origins, _ = tree.compute_link_frames(single.get_joints(last)[None])
                expected = origins[0, select_keypoint_links(tree.moving_links)]
                np.testing.assert_allclose(keypoints[row], expected, atol=1e-6)
    links = np.array([6, 9, 12, 51])
    positions, quaternions = hands.compute_link_poses(ROWS, hands.joints[:, None], TENSORS.asarray(links))
    for row, scene in enumerate(SCENES):
        expected = HandKinematics(scene.assets.hand, links).compute_poses(to_numpy(hands.joints[row])[None])
        np.testing.assert_allclose(positions[row, 0], expected[0][0], atol=1e-9)
        turns = to_numpy(quaternions)[row, 0][:, WXYZ]
        np.testing.assert_allclose(np.abs((turns * expected[1][0]).sum(axis=-1)), 1.0, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9])
def test_sensor_readings_are_those_of_arrays(share: float) -> None:
    scene = load_scene_model(SCENES[0].assets, PhysicsConfig())
    rng = np.random.default_rng(1)
    data = rng.uniform(-0.05, 0.08, (4, 3, scene.model.nsensordata)) * (rng.random((4, 3, 1)) < share)
    qpos = rng.random((4, 3, scene.model.nq))
    expected = scene.contact_sensors.compute_contact_batch(data, qpos, ProtocolConfig())
    sensors = scene.contact_sensors.move_to(TENSORS)
    found = sensors.compute_contact_batch(*map(TENSORS.asarray, (data, qpos)), ProtocolConfig())
    if share > 0.5:
        assert expected.in_grasp_region.any()
        assert not expected.in_grasp_region.all()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
