"""Trying a grasp out: a Panda hand without its arm closes on an object and shakes it.

The hand stands still and gravity turns instead. In the frame of a hand that is shaken without turning this is the same
thing, and the object starts where its own frame is the world's.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.config import ProtocolConfig
from handover_marl.models.panda import GRIPPER_FROM_HAND
from handover_marl.models.poses import compose_point, quaternion_from_matrix, rotation_angle
from handover_marl.options import pybullet_installed

Array = npt.NDArray[np.float64]

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


class GraspTrial(ABC):
    """An object and a hand in a simulation of their own; what an engine has to do for it is left open.

    Args:
        config: What a grasp must stand.
    """

    def __init__(self, config: TrialConfig | None) -> None:
        self._config = config or TrialConfig()

    def is_free(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Whether the open hand can come straight to this grasp (4, 4) without touching the object."""
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._place(grasp)
        for backoff in self._config.backoffs:
            self._put(grasp, backoff)
            if self._touches():
                return False
        return True

    def holds(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Whether the object stays in the closed hand, pushed in six directions, from this grasp (4, 4)."""
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._place(grasp)
        self._drive_fingers()
        start = self._held_pose(grasp)
        self._simulate(self._config.close_time, np.zeros(3))
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
        self._simulate(held_time, np.zeros(3))
        self._free_object()
        before = self._held_pose(grasp)
        self._simulate(free_time, np.array([0.0, 0.0, -self._config.acceleration]))
        if not self._is_gripped():
            return math.inf
        return float(np.linalg.norm(self._held_pose(grasp)[:3] - before[:3]))

    @abstractmethod
    def close(self) -> None:
        """End the simulation."""

    def _place(self, grasp: Array) -> None:
        """Object at its own frame, at rest and limp; hand at the grasp, open."""
        self._rest()
        self._put(grasp, 0.0)

    def _put(self, grasp: Array, backoff: float) -> None:
        rotation = grasp[:3, :3] @ _GRIPPER_FROM_HAND
        self._put_hand(grasp[:3, 3] - backoff * grasp[:3, 2], quaternion_from_matrix(rotation))

    def _is_gripped(self) -> bool:
        """Whether both fingers press on the object where HandoverSim's human feels a grasp."""
        rule = ProtocolConfig()
        for local in self._finger_points():
            if not ((local > rule.region_lower) & (local < rule.region_upper)).all(axis=1).any():
                return False
        return True

    def _held_pose(self, grasp: Array) -> Array:
        """Pose (7) in the fingers of the point of the object that was between the pads at first.

        The fingers are driven apart from each other, as in HandoverSim, so closed ones may drift sideways together
        and take the object along: that is no slip.
        """
        pose = self._object_pose()
        gripped = compose_point(pose, grasp[:3, 3] + _PAD_DEPTH * grasp[:3, 2])
        left, right = self._finger_joints()
        return np.concatenate([gripped - 0.5 * (left - right) * grasp[:3, 0], pose[3:]])

    def _has_moved(self, before: Array, after: Array) -> bool:
        shift = float(np.linalg.norm(after[:3] - before[:3]))
        return shift > self._config.max_shift or rotation_angle(before[3:], after[3:]) > self._config.max_turn

    @abstractmethod
    def _rest(self) -> None:
        """Object at its own frame, at rest and limp; fingers open."""

    @abstractmethod
    def _put_hand(self, position: Array, orientation: Array) -> None:
        """Hand link at a position (3,) (m) with an orientation, quaternion xyzw (4,)."""

    @abstractmethod
    def _touches(self) -> bool:
        """Whether hand and object touch where they are."""

    @abstractmethod
    def _hold_object(self) -> None:
        """With the motors that carry it in a scene."""

    @abstractmethod
    def _free_object(self) -> None:
        """Without them."""

    @abstractmethod
    def _drive_fingers(self) -> None:
        """Let them close."""

    @abstractmethod
    def _simulate(self, duration: float, gravity: Array) -> None:
        """Let time pass (s) under a gravity (3,) (m/s^2)."""

    @abstractmethod
    def _finger_points(self) -> tuple[Array, Array]:
        """Where left and right finger press on the object, (n, 3) each in the finger's frame (m)."""

    @abstractmethod
    def _object_pose(self) -> Array:
        """(7,) of the object's frame."""

    @abstractmethod
    def _finger_joints(self) -> tuple[float, float]:
        """Positions of left and right finger (m)."""


def trial_engine() -> str:
    """What tries grasps out here: "bullet" where PyBullet is installed, else "mujoco"."""
    return "bullet" if pybullet_installed() else "mujoco"


def grasp_trial(object_urdf: Path, config: TrialConfig | None = None, panda_urdf: Path = PANDA_URDF) -> GraspTrial:
    """A trial in the engine that is installed.

    Args:
        object_urdf: Model of the object, on HandoverSim's chain of six joints.
        config: What a grasp must stand.
        panda_urdf: The Panda whose hand it is.

    Raises:
        SimulationError, DataFormatError: A model cannot be read.
    """
    if trial_engine() == "bullet":
        from handover_marl.sim.bullet.bullet_trial import BulletTrial

        return BulletTrial(object_urdf, config, panda_urdf)
    from handover_marl.sim.mujoco.mujoco_trial import MujocoTrial

    return MujocoTrial(object_urdf, config, panda_urdf)
