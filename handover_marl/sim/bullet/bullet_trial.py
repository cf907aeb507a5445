"""Grasps tried out in PyBullet."""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.config import OBJECT_DOF, TIME_STEP, MotorConfig, ObjectConfig, PandaConfig
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK, OPEN
from handover_marl.models.poses import inverse_transform_points
from handover_marl.sim.bullet.client import BulletClient, connect, load_urdf
from handover_marl.sim.grasp_trial import GraspTrial, TrialConfig

Array = npt.NDArray[np.float64]

# Fields of a PyBullet contact point.
_LINK_A, _POSITION_ON_A, _NORMAL_FORCE = 3, 5, 9
_HAND_LINKS = (HAND_LINK, *FINGER_LINKS)


class BulletTrial(GraspTrial):
    """An object and a hand in a physics server of their own.

    Args:
        object_urdf: Model of the object, on HandoverSim's chain of six joints.
        config: What a grasp must stand.
        panda_urdf: The Panda whose hand it is.
    """

    def __init__(self, object_urdf: Path, config: TrialConfig | None = None, panda_urdf: Path = PANDA_URDF) -> None:
        super().__init__(config)
        self._client = connect()
        self._client.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP, numSubSteps=1, deterministicOverlappingPairs=1)
        self._object = load_urdf(self._client, object_urdf, useFixedBase=True)
        self._mesh_link = self._client.getNumJoints(self._object) - 1
        self._hand = _load_hand(self._client, panda_urdf)
        self._fingers = list(range(self._client.getNumJoints(self._hand)))

    def close(self) -> None:
        """End the physics server."""
        self._client.close()

    def _rest(self) -> None:
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
        config = ObjectConfig()
        for joint in range(OBJECT_DOF):
            motor = config.translation_motor if joint < OBJECT_DOF // 2 else config.rotation_motor
            self._drive(self._object, joint, motor)

    def _put_hand(self, position: Array, orientation: Array) -> None:
        self._client.resetBasePositionAndOrientation(self._hand, position.tolist(), orientation.tolist())

    def _touches(self) -> bool:
        return bool(self._client.getClosestPoints(self._hand, self._object, 0.0))

    def _drive_fingers(self) -> None:
        motor = PandaConfig().motor
        for finger in self._fingers:
            self._drive(self._hand, finger, motor)

    def _drive(self, body: int, joint: int, motor: MotorConfig) -> None:
        """Have a motor bring a joint to zero."""
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

    def _finger_points(self) -> tuple[Array, Array]:
        points = self._client.getContactPoints(self._hand, self._object)
        left, right = (self._points_on(finger, points) for finger in self._fingers)
        return left, right

    def _points_on(self, finger: int, points: Sequence[Any]) -> Array:
        pressed = [point[_POSITION_ON_A] for point in points if point[_LINK_A] == finger and point[_NORMAL_FORCE] > 0.0]
        if not pressed:
            return np.zeros((0, 3))
        state = self._client.getLinkState(self._hand, finger, computeForwardKinematics=1)
        return inverse_transform_points(state[4] + state[5], np.array(pressed))

    def _object_pose(self) -> Array:
        state = self._client.getLinkState(self._object, self._mesh_link, computeForwardKinematics=1)
        return np.array(state[4] + state[5])

    def _finger_joints(self) -> tuple[float, float]:
        left, right = (self._client.getJointState(self._hand, finger)[0] for finger in self._fingers)
        return left, right


def _load_hand(client: BulletClient, urdf: Path) -> int:
    """The hand and fingers of a Panda as a body of its own; joints 0 and 1 are the fingers."""
    folder = urdf.parent
    panda = ET.parse(urdf).getroot()
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
        # PyBullet poses a base by its centre of mass; here that is to be the hand's frame.
        inertial.set("xyz", "0 0 0")
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "panda_hand.urdf"
        ET.ElementTree(robot).write(path)
        return load_urdf(client, path, useFixedBase=True)
