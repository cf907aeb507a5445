"""Validation of grasps by simulating the Panda's hand and the object in PyBullet."""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.config import OBJECT_DOF, TIME_STEP, MotorConfig, ObjectConfig, PandaConfig
from handover_marl.geometry.model_files.urdf_xml import parse_urdf
from handover_marl.geometry.panda import FINGER_LINKS, HAND_LINK, OPEN
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.simulation.bullet.client import (
    CONTACT_LINK_A,
    CONTACT_NORMAL_FORCE,
    CONTACT_POSITION_ON_A,
    BulletClient,
    connect,
    load_urdf,
)
from handover_marl.simulation.grasp_validation import GraspValidationConfig, GraspValidator
from handover_marl.simulation.reference_tracking import list_object_motors

Array = npt.NDArray[np.float64]

_HAND_LINKS = (HAND_LINK, *FINGER_LINKS)


class BulletGraspValidator(GraspValidator):
    """Grasp validator with an object and a Panda hand in a separate PyBullet physics client.

    Args:
        object_urdf: Model of the object, on HandoverSim's chain of six joints.
        config: Durations, forces and tolerances of the validation.
        panda_urdf: Model of the Panda that the hand is taken from.
    """

    def __init__(
        self, object_urdf: Path, config: GraspValidationConfig | None = None, panda_urdf: Path = PANDA_URDF
    ) -> None:
        super().__init__(config)
        self._client = connect()
        self._client.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP, numSubSteps=1, deterministicOverlappingPairs=1)
        self._object = load_urdf(self._client, object_urdf, useFixedBase=True)
        self._mesh_link = self._client.getNumJoints(self._object) - 1
        self._hand = _load_hand(self._client, panda_urdf)
        self._fingers = list(range(self._client.getNumJoints(self._hand)))

    def close(self) -> None:
        """Disconnect from the PyBullet physics server."""
        self._client.close()

    def _reset_bodies(self) -> None:
        for joint in range(OBJECT_DOF):
            self._client.resetJointState(self._object, joint, 0.0, 0.0)
        self._free_object()
        for finger in self._fingers:
            self._client.resetJointState(self._hand, finger, OPEN, 0.0)

    def _free_object(self) -> None:
        self._client.setJointMotorControlArray(
            self._object, range(OBJECT_DOF), self._client.VELOCITY_CONTROL, forces=[0.0] * OBJECT_DOF
        )

    def _hold_object(self) -> None:
        for joint, motor in enumerate(list_object_motors(ObjectConfig())):
            self._set_motor(self._object, joint, motor)

    def _set_hand_pose(self, position: Array, orientation: Array) -> None:
        self._client.resetBasePositionAndOrientation(self._hand, position.tolist(), orientation.tolist())

    def _has_contact(self) -> bool:
        return bool(self._client.getClosestPoints(self._hand, self._object, 0.0))

    def _close_fingers(self) -> None:
        motor = PandaConfig().motor
        for finger in self._fingers:
            self._set_motor(self._hand, finger, motor)

    def _set_motor(self, body: int, joint: int, motor: MotorConfig) -> None:
        """Set the target position of a joint's motor to zero."""
        self._client.setJointMotorControl2(
            body,
            joint,
            self._client.POSITION_CONTROL,
            targetPosition=0.0,
            positionGain=motor.position_gain,
            velocityGain=motor.velocity_gain,
            force=motor.force,
        )

    def _simulate(self, duration: float, gravity: Array) -> None:
        self._client.setGravity(*gravity.tolist())
        for _ in range(round(duration / TIME_STEP)):
            self._client.stepSimulation()

    def _read_finger_points(self) -> tuple[Array, Array]:
        points = self._client.getContactPoints(self._hand, self._object)
        left, right = (self._select_finger_points(finger, points) for finger in self._fingers)
        return left, right

    def _select_finger_points(self, finger: int, points: Sequence[Any]) -> Array:
        pressing = [point for point in points if point[CONTACT_LINK_A] == finger and point[CONTACT_NORMAL_FORCE] > 0.0]
        if not pressing:
            return np.zeros((0, 3))
        state = self._client.getLinkState(self._hand, finger, computeForwardKinematics=1)
        positions = np.array([point[CONTACT_POSITION_ON_A] for point in pressing])
        return np.asarray(inverse_transform_points(state[4] + state[5], positions))

    def _read_object_pose(self) -> Array:
        state = self._client.getLinkState(self._object, self._mesh_link, computeForwardKinematics=1)
        return np.array(state[4] + state[5])

    def _read_finger_joints(self) -> tuple[float, float]:
        left, right = (self._client.getJointState(self._hand, finger)[0] for finger in self._fingers)
        return left, right


def _load_hand(client: BulletClient, urdf: Path) -> int:
    """Load hand and fingers of a Panda as one PyBullet body, and return its body number.

    Its joints 0 and 1 are the fingers.
    """
    folder = urdf.parent
    panda = parse_urdf(urdf)
    robot = ET.Element("robot", name="panda_hand")
    for element in panda:
        child = element.find("child")
        is_finger_joint = child is not None and child.get("link") in _HAND_LINKS[1:]
        if element.tag == "material" or element.get("name") in _HAND_LINKS or is_finger_joint:
            robot.append(element)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(mesh.get("filename")).replace("package://", f"{folder}/"))
    inertial = robot.find("link[@name='panda_hand']/inertial/origin")
    if inertial is not None:
        # PyBullet sets the pose of a base at its centre of mass; this moves it to the hand's frame.
        inertial.set("xyz", "0 0 0")
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "panda_hand.urdf"
        ET.ElementTree(robot).write(path)
        return load_urdf(client, path, useFixedBase=True)
