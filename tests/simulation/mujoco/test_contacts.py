"""Tests of the contact sensors against MuJoCo's contacts, for one world and for several at once."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import FINGER_LINKS, WAITING_JOINTS
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model

NOWHERE = (0.0, 0.0, -10.0)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    data = SyntheticDataset()
    return load_scene_model(data.load_scene(86).assets, PhysicsConfig())


def find_fingers(scene: SceneModel) -> list[int]:
    return [scene.model.body(name).id for name in FINGER_LINKS]


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
    touches = scene.contact_sensors.read_contacts(data.sensordata)
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
    for finger, found in zip(
        find_fingers(scene), scene.contact_sensors.read_finger_forces(data.sensordata), strict=True
    ):
        assert sorted(found[found > 0.0]) == pytest.approx(sorted(forces[int(finger)]))
    assert not touches.robot_touches_hand
    assert not touches.object_supported


def test_points_lie_on_the_pads(scene: SceneModel) -> None:
    data = closed_on_target(scene)
    turns = data.xmat[find_fingers(scene)].reshape(2, 3, 3)
    points = scene.contact_sensors.compute_finger_points(data.sensordata, data.xpos[find_fingers(scene)], turns)
    forces = scene.contact_sensors.read_finger_forces(data.sensordata)
    for side in range(2):
        pressed = points[side][forces[side] > 0.0]
        assert len(pressed)
        assert (np.abs(pressed[:, 0]) < 0.012).all()
        assert (np.abs(pressed[:, 1]) < 0.009).all(), "within the pads' depth"
        assert ((pressed[:, 2] > 0.0) & (pressed[:, 2] < 0.056)).all()


def test_many_worlds_are_read_like_one(scene: SceneModel) -> None:
    data = closed_on_target(scene)
    rows = np.stack([data.sensordata, np.zeros_like(data.sensordata), 2.0 * data.sensordata])
    many = scene.contact_sensors.read_contacts(rows)
    assert scene.contact_sensors.read_finger_forces(rows).shape == (3, 2, 8)
    for row, own in enumerate(rows):
        one = scene.contact_sensors.read_contacts(own)
        np.testing.assert_array_equal(
            scene.contact_sensors.read_finger_forces(rows)[row], scene.contact_sensors.read_finger_forces(rows[row])
        )
        assert many.robot_object_force[row] == one.robot_object_force
    assert many.robot_object_force[1] == 0.0
    origins = np.repeat(data.xpos[find_fingers(scene)][None], 3, axis=0)
    turns = np.repeat(data.xmat[find_fingers(scene)].reshape(1, 2, 3, 3), 3, axis=0)
    points = scene.contact_sensors.compute_finger_points(rows, origins, turns)
    np.testing.assert_array_equal(points[0], scene.contact_sensors.compute_finger_points(rows[0], origins[0], turns[0]))


def test_hand_and_other_objects_are_sensed(scene: SceneModel) -> None:
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[scene.robot_qpos] = data.ctrl[scene.robot_ctrl] = WAITING_JOINTS
    data.mocap_pos[scene.hand] = NOWHERE
    places = [scene.object_qpos.start + 7 * number for number in range(len(scene.objects))]
    for number, place in enumerate(places):
        data.qpos[place : place + 3] = (5.0, float(number), 1.0)
    mujoco.mj_step(model, data)
    readings = scene.contact_sensors.read_contacts(data.sensordata)
    assert not readings.robot_touches_others
    assert not readings.robot_touches_hand
    data.mocap_pos[scene.hand.stop - 3 : scene.hand.stop] = data.xpos[scene.gripper]
    mujoco.mj_step(model, data)
    assert scene.contact_sensors.read_contacts(data.sensordata).robot_touches_hand
    forces, force = [], np.zeros(6)
    for number in range(data.ncon):
        if np.isin(model.geom_bodyid[data.contact[number].geom], np.arange(model.nbody)[scene.hand]).any():
            mujoco.mj_contactForce(model, data, number, force)
            forces.append(force[0])
    assert len(forces) > 3
    assert scene.contact_sensors.read_hand_force(data.sensordata) == pytest.approx(sum(forces))
    data.mocap_pos[scene.hand] = NOWHERE
    data.qpos[places[-1] : places[-1] + 3] = data.xpos[scene.gripper]
    mujoco.mj_step(model, data)
    readings = scene.contact_sensors.read_contacts(data.sensordata)
    assert readings.robot_touches_others
    assert readings.robot_object_force == 0.0
