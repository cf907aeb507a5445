"""Tests of the contact sensors against MuJoCo's contacts, for one world and for several at once."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import FINGER_LINKS, WAITING_JOINTS
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model
from handover_marl.simulation.world import Contacts


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return load_scene_model(SyntheticDataset().load_scene(86).assets, PhysicsConfig())


def read_contacts(scene: SceneModel, data: "mujoco.MjData") -> Contacts:
    return scene.contact_sensors.compute_contacts(data.sensordata, data.qpos, True)


def place_objects(scene: SceneModel) -> "mujoco.MjData":
    """Return a state in which hand and objects are far from the robot."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.robot_qpos] = data.ctrl[scene.robot_ctrl] = WAITING_JOINTS
    data.mocap_pos[scene.hand] = (0.0, 0.0, -10.0)
    poses, targets = data.qpos[scene.object_qpos].reshape(-1, 7), data.ctrl[scene.object_ctrl].reshape(-1, 6)
    for number in range(len(poses)):
        poses[number, :3] = targets[number, :3] = (5.0, float(number), 1.0)
    mujoco.mj_step(scene.model, data)
    return data


@pytest.fixture(scope="module")
def grasp(scene: SceneModel) -> "mujoco.MjData":
    """Return a state in which the fingers press on the object that is held between them."""
    data = place_objects(scene)
    fingers = [scene.model.body(name).id for name in FINGER_LINKS]
    between = data.xpos[fingers].mean(axis=0) + 0.04 * data.xmat[scene.gripper].reshape(3, 3)[:, 2]
    first, motors = scene.object_qpos.start, scene.object_ctrl.start
    data.qpos[first : first + 3] = data.ctrl[motors : motors + 3] = between
    data.ctrl[scene.robot_ctrl.stop - 2 : scene.robot_ctrl.stop] = 0.0
    for _ in range(300):
        mujoco.mj_step(scene.model, data)
    return data


def list_forces(scene: SceneModel, data: "mujoco.MjData", bodies: object) -> list[tuple[set[int], float]]:
    """Return both bodies and the normal force of each contact with any of some bodies."""
    found, force = [], np.zeros(6)
    for number in range(data.ncon):
        pair = {int(scene.model.geom_bodyid[geom]) for geom in data.contact[number].geom}
        if np.isin([*pair], bodies).any():
            mujoco.mj_contactForce(scene.model, data, number, force)
            found.append((pair, float(force[0])))
    return found


def test_sensors_agree_with_the_engines_contacts(scene: SceneModel, grasp: "mujoco.MjData") -> None:
    contacts, forces = read_contacts(scene, grasp), list_forces(scene, grasp, scene.objects[0])
    assert contacts.robot_object_force == pytest.approx(sum(force for _, force in forces))
    assert contacts.robot_object_force > 10.0
    assert not contacts.robot_touches_hand
    assert not contacts.object_supported
    for finger, points in zip(FINGER_LINKS, contacts.finger_points, strict=True):
        assert len(points) == sum(scene.model.body(finger).id in pair for pair, _ in forces) > 0
        # The points lie on the pads, within their depth.
        assert (np.abs(points[:, :2]) < (0.012, 0.009)).all()
        assert ((points[:, 2] > 0.0) & (points[:, 2] < 0.056)).all()


def test_hand_and_other_objects_are_sensed(scene: SceneModel) -> None:
    data = place_objects(scene)
    assert read_contacts(scene, data)._replace(object_height=0.0, gripper_position=(0.0,) * 3) == Contacts(
        object_height=0.0, gripper_position=(0.0,) * 3
    )
    data.mocap_pos[scene.hand.stop - 3 : scene.hand.stop] = data.xpos[scene.gripper]
    mujoco.mj_step(scene.model, data)
    forces = list_forces(scene, data, np.flatnonzero(scene.model.body_mocapid >= scene.hand.start))
    assert len(forces) > 3
    assert read_contacts(scene, data).robot_hand_force == pytest.approx(sum(force for _, force in forces))
    data = place_objects(scene)
    data.qpos[scene.object_qpos].reshape(-1, 7)[-1, :3] = data.xpos[scene.gripper]
    mujoco.mj_step(scene.model, data)
    contacts = read_contacts(scene, data)
    assert contacts.robot_touches_others
    assert contacts.robot_object_force == 0.0
