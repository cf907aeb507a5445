"""Trying a grasp out: a Panda hand without its arm closes on an object and shakes it.

The hand stands still and the world's gravity turns instead. In the frame of a hand that is shaken without turning
this is the same thing, and the object starts where its own frame is the world's.
"""

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.bullet_files import bullet_files
from handover_marl.config import OBJECT_DOF, TIME_STEP, MotorConfig, ObjectConfig, PandaConfig, ProtocolConfig
from handover_marl.models.panda import FINGER_LINKS, GRIPPER_FROM_HAND, HAND_LINK, OPEN
from handover_marl.models.poses import (
    compose_point,
    inverse_transform_points,
    quaternion_from_matrix,
    rotation_angle,
)
from handover_marl.sim.bullet.client import BulletClient, connect, load_urdf

# Fields of a PyBullet contact point.
_LINK_A, _POSITION_ON_A, _NORMAL_FORCE = 3, 5, 9
_HAND_LINKS = (HAND_LINK, *FINGER_LINKS)
_PAD_DEPTH = 0.1  # m, from the hand's frame to between the finger pads
# Grasp files turn the hand by 90 degrees about its approach axis: the fingers close along the gripper frame's x.
_GRIPPER_FROM_HAND = np.rint(Rotation.from_quat(GRIPPER_FROM_HAND[3:]).as_matrix())


@dataclass(frozen=True)
class TrialConfig:
    """What a grasp must stand.

    Attributes:
        close_time: Time for the fingers to close (s), as in HandoverSim's baselines.
        shake_time: Time of each push (s).
        acceleration: Size of each push (m/s^2): gravity and as much again half.
        max_shift: How far the gripped point of the object may move relative to the fingers (m), while it is
            gripped and again while it is shaken.
        max_turn: How far it may turn (rad), likewise.
        backoffs: Distances (m) before the grasp at which the open hand must be free of the object too.
    """

    close_time: float = 0.5
    shake_time: float = 0.1
    acceleration: float = 14.7
    max_shift: float = 0.015
    max_turn: float = 0.3
    backoffs: tuple[float, ...] = (0.0, 0.015, 0.03, 0.045, 0.06, 0.08, 0.1)


class GraspTrial:
    """An object and a hand in a physics server of their own.

    Args:
        object_urdf: Model of the object, on HandoverSim's chain of six joints.
        config: What a grasp must stand.
        panda_urdf: The Panda whose hand it is; default: PyBullet's.
    """

    def __init__(self, object_urdf: Path, config: TrialConfig | None = None, panda_urdf: Path | None = None) -> None:
        self._config = config or TrialConfig()
        self._client = connect()
        self._client.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP, numSubSteps=1, deterministicOverlappingPairs=1)
        self._object_urdf = object_urdf
        self._object = load_urdf(self._client, object_urdf, useFixedBase=True)
        self._mesh_link = self._client.getNumJoints(self._object) - 1
        self._hand = _load_hand(self._client, panda_urdf or _panda_folder() / "panda.urdf")
        self._fingers = list(range(self._client.getNumJoints(self._hand)))

    def is_free(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Whether the open hand can come straight to this grasp (4, 4) without touching the object."""
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._place(grasp)
        for backoff in self._config.backoffs:
            self._put_hand(grasp, backoff)
            if self._client.getClosestPoints(self._hand, self._object, 0.0):
                return False
        return True

    def holds(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Whether the object stays in the closed hand, pushed in six directions, from this grasp (4, 4)."""
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._place(grasp)
        self._drive_fingers()
        start = self._held_pose(grasp)
        self._simulate(self._config.close_time, (0.0, 0.0, 0.0))
        held = self._held_pose(grasp)
        if not self._is_gripped() or self._has_moved(start, held):
            return False
        for direction in np.concatenate([np.eye(3), -np.eye(3)]):
            self._simulate(self._config.shake_time, self._config.acceleration * direction)
            if not self._is_gripped() or self._has_moved(held, self._held_pose(grasp)):
                return False
        return True

    def slip_on_release(self, object_from_gripper: npt.ArrayLike, held_time: float, free_time: float) -> float:
        """How far the gripped point moves in the fingers (m) when the object is let go by who held it in its place.

        In a scene a person holds the object while the fingers close and lets go a tenth of a second later: what they
        touch with an edge only springs away then.

        Args:
            object_from_gripper: The grasp (4, 4).
            held_time: How long the object is held while the fingers close (s).
            free_time: How long it is free (s).

        Returns:
            Infinity if a finger does not touch it in the end.
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._place(grasp)
        self._hold_object()
        self._drive_fingers()
        self._simulate(held_time, (0.0, 0.0, 0.0))
        self._free_object()
        before = self._held_pose(grasp)
        self._simulate(free_time, (0.0, 0.0, -self._config.acceleration))
        if not self._is_gripped():
            return math.inf
        return float(np.linalg.norm(self._held_pose(grasp)[:3] - before[:3]))

    def close(self) -> None:
        """End the physics server."""
        self._client.close()

    def _place(self, grasp: npt.NDArray[np.float64]) -> None:
        """Object at its own frame, at rest and limp; hand at the grasp, open."""
        for joint in range(OBJECT_DOF):
            self._client.resetJointState(self._object, joint, 0.0, 0.0)
        self._free_object()
        for finger in self._fingers:
            self._client.resetJointState(self._hand, finger, OPEN, 0.0)
        self._put_hand(grasp, 0.0)

    def _free_object(self) -> None:
        self._client.setJointMotorControlArray(
            self._object, range(OBJECT_DOF), self._client.VELOCITY_CONTROL, forces=[0.0] * OBJECT_DOF
        )

    def _hold_object(self) -> None:
        """With the motors that carry it in a scene."""
        config = ObjectConfig()
        for joint in range(OBJECT_DOF):
            motor = config.translation_motor if joint < OBJECT_DOF // 2 else config.rotation_motor
            self._drive(self._object, joint, motor)

    def _put_hand(self, grasp: npt.NDArray[np.float64], backoff: float) -> None:
        position = grasp[:3, 3] - backoff * grasp[:3, 2]
        rotation = grasp[:3, :3] @ _GRIPPER_FROM_HAND
        self._client.resetBasePositionAndOrientation(
            self._hand, position.tolist(), quaternion_from_matrix(rotation).tolist()
        )

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

    def _simulate(self, duration: float, gravity: Sequence[float] | npt.NDArray[np.float64]) -> None:
        self._client.setGravity(*(float(component) for component in gravity))
        for _ in range(round(duration / TIME_STEP)):
            self._client.stepSimulation()

    def _is_gripped(self) -> bool:
        """Whether either finger presses on the object where HandoverSim's human feels a grasp."""
        rule = ProtocolConfig()
        points = self._client.getContactPoints(self._hand, self._object)
        for finger in self._fingers:
            on_finger = [
                point[_POSITION_ON_A] for point in points if point[_LINK_A] == finger and point[_NORMAL_FORCE] > 0.0
            ]
            if not on_finger:
                return False
            state = self._client.getLinkState(self._hand, finger, computeForwardKinematics=1)
            local = inverse_transform_points(state[4] + state[5], np.array(on_finger))
            if not ((local > rule.region_lower) & (local < rule.region_upper)).all(axis=1).any():
                return False
        return True

    def _held_pose(self, grasp: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Pose (7) in the fingers of the point of the object that was between the pads at first.

        The fingers are driven apart from each other, as in HandoverSim, so closed ones may drift sideways together
        and take the object along: that is no slip.
        """
        state = self._client.getLinkState(self._object, self._mesh_link, computeForwardKinematics=1)
        gripped = compose_point(state[4] + state[5], grasp[:3, 3] + _PAD_DEPTH * grasp[:3, 2])
        left, right = (self._client.getJointState(self._hand, finger)[0] for finger in self._fingers)
        return np.concatenate([gripped - 0.5 * (left - right) * grasp[:3, 0], state[5]])

    def _has_moved(self, before: npt.NDArray[np.float64], after: npt.NDArray[np.float64]) -> bool:
        shift = float(np.linalg.norm(after[:3] - before[:3]))
        return shift > self._config.max_shift or rotation_angle(before[3:], after[3:]) > self._config.max_turn


def _panda_folder() -> Path:
    return bullet_files() / "franka_panda"


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
