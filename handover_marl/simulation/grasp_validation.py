"""Validation of grasps in simulation: a Panda hand without arm closes on an object and shakes it.

The hand stays fixed and the direction of gravity changes instead. In the frame of a hand that is
shaken without rotation this is equivalent. At the start the frame of the object is the world
frame. Grasps are 4x4 matrices of the gripper in the object's frame; quaternions are xyzw.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ProtocolConfig
from handover_marl.geometry.panda import GRIPPER_FROM_HAND, PAD_DISTANCE
from handover_marl.geometry.poses import compute_rotation_angle, quaternion_from_matrix, transform_points
from handover_marl.simulation.contacts import find_points_in_grasp_region

Array = npt.NDArray[np.float64]

# Grasp files rotate the hand by 90 degrees about its approach axis: the fingers close along the
# gripper frame's x.
_GRIPPER_FROM_HAND = np.rint(Rotation.from_quat(GRIPPER_FROM_HAND[3:]).as_matrix())


@dataclass(frozen=True)
class GraspValidationConfig:
    """Conditions that a valid grasp of an object must satisfy in simulation.

    Attributes:
        close_time: Time for which the fingers close (s), as in HandoverSim's baselines.
        shake_time: Duration of each of six pushes (s).
        acceleration: Acceleration of each push (m/s^2), 1.5 times gravity.
        max_translation: Largest displacement of the gripped point relative to the fingers (m) while
            they close, and again while the object is shaken.
        max_rotation: Largest rotation of the object (rad) while the fingers close, and again while
            the object is shaken.
        standoff_distances: Distances from the grasp, back along the approach direction, at which the
            open hand must not touch the object either (m).
    """

    close_time: float = 0.5
    shake_time: float = 0.1
    acceleration: float = 14.7
    max_translation: float = 0.015
    max_rotation: float = 0.3
    standoff_distances: tuple[float, ...] = (0.0, 0.015, 0.03, 0.045, 0.06, 0.08, 0.1)


class GraspValidator(ABC):
    """Base class of the grasp validators: simulates an object and a Panda hand without an arm.

    Args:
        config: Conditions of a valid grasp.
    """

    def __init__(self, config: GraspValidationConfig | None) -> None:
        self._config = config or GraspValidationConfig()

    def is_collision_free(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Return whether the open hand reaches a grasp pose in a straight line without contact.

        Args:
            object_from_gripper: Grasp (4, 4).
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._reset(grasp)
        for distance in self._config.standoff_distances:
            self._set_hand_before(grasp, distance)
            if self._has_contact():
                return False
        return True

    def is_stable(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Return whether the Panda hand holds the object at a grasp pose while shaking it.

        Args:
            object_from_gripper: Grasp (4, 4).
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._reset(grasp)
        self._close_fingers()
        start = self._read_gripped_pose(grasp)
        self._simulate(self._config.close_time, np.zeros(3))
        held = self._read_gripped_pose(grasp)
        if not self._is_gripped() or self._has_moved(start, held):
            return False
        for direction in np.concatenate([np.eye(3), -np.eye(3)]):
            self._simulate(self._config.shake_time, self._config.acceleration * direction)
            if not self._is_gripped() or self._has_moved(held, self._read_gripped_pose(grasp)):
                return False
        return True

    def measure_release_slip(self, object_from_gripper: npt.ArrayLike, held_time: float, free_time: float) -> float:
        """Measure the object's displacement relative to the fingers (m) after a person releases it.

        In a scene a person holds the object while the fingers close and releases it 0.1 s later. An
        object that only the edge of a finger touches slips away then.

        Args:
            object_from_gripper: Grasp (4, 4).
            held_time: Time for which the object is held while the fingers close (s).
            free_time: Time after the release (s).

        Returns:
            Displacement (m); infinity if a finger does not touch the object in the end.
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._reset(grasp)
        self._hold_object()
        self._close_fingers()
        self._simulate(held_time, np.zeros(3))
        self._free_object()
        before = self._read_gripped_pose(grasp)
        self._simulate(free_time, np.array([0.0, 0.0, -self._config.acceleration]))
        if not self._is_gripped():
            return math.inf
        return float(np.linalg.norm(self._read_gripped_pose(grasp)[:3] - before[:3]))

    @abstractmethod
    def close(self) -> None:
        """Free the memory of the simulation."""

    def _reset(self, grasp: Array) -> None:
        """Reset the object to its initial pose, at rest, and the open hand to a grasp pose."""
        self._reset_bodies()
        self._set_hand_before(grasp, 0.0)

    def _set_hand_before(self, grasp: Array, distance: float) -> None:
        rotation = grasp[:3, :3] @ _GRIPPER_FROM_HAND
        self._set_hand_pose(grasp[:3, 3] - distance * grasp[:3, 2], quaternion_from_matrix(rotation))

    def _is_gripped(self) -> bool:
        """Return whether both fingers press on the object inside HandoverSim's grasp region."""
        rule = ProtocolConfig()
        return all(find_points_in_grasp_region(points, rule).any() for points in self._read_finger_points())

    def _read_gripped_pose(self, grasp: Array) -> Array:
        """Return the pose (7,) of the gripped object point relative to the fingers.

        At the start that point is in the middle between the finger pads.

        The finger motors are independent, as in HandoverSim: closed fingers may drift sideways
        together and take the object along, which is no slip.
        """
        pose = self._read_object_pose()
        gripped = transform_points(pose, grasp[:3, 3] + PAD_DISTANCE * grasp[:3, 2])
        left, right = self._read_finger_joints()
        return np.concatenate([gripped - 0.5 * (left - right) * grasp[:3, 0], pose[3:]])

    def _has_moved(self, before: Array, after: Array) -> bool:
        shift = float(np.linalg.norm(after[:3] - before[:3]))
        rotation = compute_rotation_angle(before[3:], after[3:])
        return shift > self._config.max_translation or rotation > self._config.max_rotation

    @abstractmethod
    def _reset_bodies(self) -> None:
        """Reset the object to its initial pose, free and at rest, and open the fingers."""

    @abstractmethod
    def _set_hand_pose(self, position: Array, orientation: Array) -> None:
        """Set the world pose of the Panda's hand link: position (3,) (m), quaternion xyzw (4,)."""

    @abstractmethod
    def _has_contact(self) -> bool:
        """Return whether Panda hand and object touch in their current poses."""

    @abstractmethod
    def _hold_object(self) -> None:
        """Hold the object with the motors of its six joints."""

    @abstractmethod
    def _free_object(self) -> None:
        """Disable the motors of the object's six joints."""

    @abstractmethod
    def _close_fingers(self) -> None:
        """Set the motor targets of both fingers to the closed position."""

    @abstractmethod
    def _simulate(self, duration: float, gravity: Array) -> None:
        """Simulate object and hand for a duration (s) under a gravity vector (3,) (m/s^2)."""

    @abstractmethod
    def _read_finger_points(self) -> tuple[Array, Array]:
        """Return each finger's contact points (n, 3) with the object, in its frame (m)."""

    @abstractmethod
    def _read_object_pose(self) -> Array:
        """Return the world pose (7,) of the object: xyz (m), quaternion xyzw."""

    @abstractmethod
    def _read_finger_joints(self) -> tuple[float, float]:
        """Return the joint positions of the left and the right finger (m)."""
