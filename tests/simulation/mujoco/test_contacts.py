"""Tests of the contact sensors against MuJoCo's contacts, for one world and for several at once."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import FINGER_LINKS, WAITING_JOINTS
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model

NOWHERE = (0.0, 0.0, -10.0)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    data = SyntheticDataset()
    return load_scene_model(data.load_scene(86).assets, PhysicsConfig())


def find_fingers(scene: SceneModel) -> list[int]:
    return [scene.model.body(name).id for name in FINGER_LINKS]


def read_contacts(scene: SceneModel, data: "mujoco.MjData") -> Contacts:
    return scene.contact_sensors.compute_contacts(data.sensordata, data.qpos, True)


def closed_on_target(scene: SceneModel) -> "mujoco.MjData":
    """Return a state in which the fingers press on the object that is held between them."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.robot_qpos] = data.ctrl[scene.robot_ctrl] = WAITING_JOINTS
    data.mocap_pos[scene.hand] = NOWHERE
    mujoco.mj_kinematics(scene.model, data)
    between = data.xpos[find_fingers(scene)].mean(axis=0) + 0.04 * data.xmat[scene.gripper].reshape(3, 3)[:, 2]
    first, servos = scene.object_qpos.start, scene.object_ctrl.start
    data.qpos[first : first + 3] = data.ctrl[servos : servos + 3] = between
    others = np.arange(1, len(scene.objects))
    for number in others:
        data.qpos[first + 7 * number : first + 7 * number + 3] = (5.0, float(number), 1.0)
        data.ctrl[servos + 6 * number : servos + 6 * number + 3] = (5.0, float(number), 1.0)
    data.ctrl[scene.robot_ctrl.stop - 2 : scene.robot_ctrl.stop] = 0.0
    for _ in range(300):
        mujoco.mj_step(scene.model, data)
    return data


def test_sensors_agree_with_the_engines_contacts(scene: SceneModel) -> None:
    data = closed_on_target(scene)
    touches = read_contacts(scene, data)
    model, target = scene.model, scene.objects[0]
    forces = {int(finger): [] for finger in find_fingers(scene)}
    total = 0.0
    for number in range(data.ncon):
        bodies = [int(model.geom_bodyid[geom]) for geom in data.contact[number].geom]
        force = np.zeros(6)
        mujoco.mj_contactForce(model, data, number, force)
        if target in bodies:
            total += force[0]
            (own,) = [body for body in bodies if body != target]
            forces.setdefault(own, []).append(force[0])
    assert total > 10.0
    assert float(touches.robot_object_force) == pytest.approx(total)
    for finger, found in zip(find_fingers(scene), touches.finger_points, strict=True):
        assert len(found) == len(forces[finger])
    assert not touches.robot_touches_hand
    assert not touches.object_supported


def test_points_lie_on_the_pads(scene: SceneModel) -> None:
    data = closed_on_target(scene)
    for pressed in read_contacts(scene, data).finger_points:
        assert len(pressed)
        assert (np.abs(pressed[:, 0]) < 0.012).all()
        assert (np.abs(pressed[:, 1]) < 0.009).all(), "within the pads' depth"
        assert ((pressed[:, 2] > 0.0) & (pressed[:, 2] < 0.056)).all()


def test_many_worlds_are_read_like_one(scene: SceneModel) -> None:
    data = closed_on_target(scene)
    rows = np.stack([data.sensordata, np.zeros_like(data.sensordata), 2.0 * data.sensordata])
    many = scene.contact_sensors.compute_contact_batch(rows[None], np.stack([data.qpos] * 3)[None], ProtocolConfig())
    points = scene.contact_sensors.compute_finger_points(rows)
    for row, own in enumerate(rows):
        one = scene.contact_sensors.compute_contacts(own, data.qpos, True)
        np.testing.assert_array_equal(points[row], scene.contact_sensors.compute_finger_points(own))
        assert many.robot_touches_object[0, row] == one.robot_touches_object == (row != 1)
        assert many.fingers_touch[0, row].all() == one.both_fingers_touch
        assert many.gripper_position[0, row].tolist() == list(one.gripper_position)


def test_hand_and_other_objects_are_sensed(scene: SceneModel) -> None:
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[scene.robot_qpos] = data.ctrl[scene.robot_ctrl] = WAITING_JOINTS
    data.mocap_pos[scene.hand] = NOWHERE
    places = [scene.object_qpos.start + 7 * number for number in range(len(scene.objects))]
    for number, place in enumerate(places):
        data.qpos[place : place + 3] = (5.0, float(number), 1.0)
    mujoco.mj_step(model, data)
    readings = read_contacts(scene, data)
    assert not readings.robot_touches_others
    assert not readings.robot_touches_hand
    data.mocap_pos[scene.hand.stop - 3 : scene.hand.stop] = data.xpos[scene.gripper]
    mujoco.mj_step(model, data)
    assert read_contacts(scene, data).robot_touches_hand
    forces, force = [], np.zeros(6)
    for number in range(data.ncon):
        if np.isin(model.geom_bodyid[data.contact[number].geom], np.arange(model.nbody)[scene.hand]).any():
            mujoco.mj_contactForce(model, data, number, force)
            forces.append(force[0])
    assert len(forces) > 3
    assert read_contacts(scene, data).robot_hand_force == pytest.approx(sum(forces))
    data.mocap_pos[scene.hand] = NOWHERE
    data.qpos[places[-1] : places[-1] + 3] = data.xpos[scene.gripper]
    mujoco.mj_step(model, data)
    readings = read_contacts(scene, data)
    assert readings.robot_touches_others
    assert readings.robot_object_force == 0.0
