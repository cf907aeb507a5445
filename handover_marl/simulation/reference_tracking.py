"""Motion of hand and objects without contact: joints whose motors track a reference.

Row k is step k of the current reference motion; row -1 is the state before its first step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, TIME_STEP, HandConfig, MotorConfig, ObjectConfig
from handover_marl.geometry.arrays import AnyArray
from handover_marl.geometry.kinematic_tree import KinematicTree

Array = npt.NDArray[np.float64]

#: Number of joints that carry the whole hand: three prismatic, three revolute.
BASE_JOINTS = 6
#: Number of the hand's link at the wrist.
WRIST_LINK = 6


@dataclass(frozen=True, eq=False)
class ReferenceMotion:
    """Joint targets of human hand and objects in each of n physics steps (world frame, m, rad).

    Attributes:
        objects: Joint targets (n, m, 6) of the m objects in the scene's order, float32.
        hand: Joint targets (n, 51) of the hand, float32.
        hand_present: Whether the hand is in the scene in each step, (n,).
    """

    objects: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32]
    hand_present: npt.NDArray[np.bool_]

    def list_hand_targets(self) -> list[list[float] | None]:
        """Return the hand's 51 joint targets in each step; None in steps without a hand."""
        return [
            row if present else None
            for row, present in zip(self.hand.tolist(), self.hand_present.tolist(), strict=True)
        ]


@dataclass(frozen=True, eq=False)
class ReferenceBatch:
    """Joint targets of hands and objects of n worlds in each of k physics steps (world frame, m, rad).

    Attributes:
        hand: Joint targets (n, k, 51) of the hands, float32.
        hand_present: Whether the hand is in the scene in each step, (n, k).
        objects: Joint targets (n, k, 5, 6) of the objects: xyz, Euler angles; zeros for no object, float32.
    """

    hand: AnyArray
    hand_present: AnyArray
    objects: AnyArray

    def select_rows(self, rows: AnyArray) -> "ReferenceBatch":
        """Return the targets of worlds with these indices."""
        return ReferenceBatch(self.hand[rows], self.hand_present[rows], self.objects[rows])

    def select(self, number: int, n_objects: int) -> ReferenceMotion:
        """Return the reference motion of one world with some number of objects."""
        return ReferenceMotion(self.objects[number, :, :n_objects], self.hand[number], self.hand_present[number])


class MotorModel:
    """Kinematic model of d joints, whose error falls by a fixed ratio per step as in Bullet.

    Without contact the joint positions differ by less than 1e-4 (m, rad) from simulated ones.

    Args:
        motors: Parameters of each of the d motors.
        start: Initial joint positions (d,) (m, rad).

    Attributes:
        gains: Fraction (d,) of its position error that each joint corrects in a step.
        position: Joint positions (d,) at the end of `trajectory` (m, rad).
        trajectory: Joint positions (n, d) after each step of the current reference.
    """

    def __init__(self, motors: Sequence[MotorConfig], start: npt.ArrayLike) -> None:
        self.gains = np.array([motor.position_gain for motor in motors])
        self.position = np.array(start, dtype=np.float64)
        self.trajectory = self.position[None]


def simulate_motors(models: Sequence[MotorModel], targets: Sequence[npt.NDArray[np.float32]]) -> None:
    """Compute the trajectories of motor models with equally many joints.

    The trajectories do not depend on how targets are divided into calls.

    Args:
        models: Motor models; `trajectory` and `position` are updated.
        targets: Joint targets (n, d) of each model in n steps (m, rad).
    """
    moving: dict[int, list[tuple[MotorModel, Array]]] = {}
    for model, own in zip(models, targets, strict=True):
        wanted = own.astype(np.float64)
        if (wanted == model.position).all():
            # The recurrence gives the same for joints at rest, only slower.
            model.trajectory = wanted
        else:
            moving.setdefault(len(wanted), []).append((model, wanted))
    for steps, group in moving.items():
        gains = np.array([model.gains for model, _ in group])
        position = np.array([model.position for model, _ in group])
        wanted = np.stack([own for _, own in group], axis=1)
        trajectories, error = np.empty(wanted.shape), np.empty(position.shape)
        for row in range(steps):
            np.subtract(wanted[row], position, out=error)
            np.multiply(gains, error, out=error)
            position = np.add(position, error, out=trajectories[row])
        for number, (model, _) in enumerate(group):
            model.trajectory = trajectories[:, number]
            model.position = model.trajectory[-1]


def list_hand_motors(config: HandConfig) -> list[MotorConfig]:
    """Return the motor parameters of the human hand's 51 joints."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3 + [config.finger_motor] * 45


def list_object_motors(config: ObjectConfig) -> list[MotorConfig]:
    """Return the motor parameters of an object's six joints: xyz and intrinsic XYZ Euler angles."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3


def select_keypoint_links(joints: Sequence[int]) -> list[int]:
    """Return the numbers of the links whose origins are the hand's 16 keypoints.

    The keypoints are the wrist and 15 finger joints.

    Args:
        joints: Numbers of the child links of the 51 moving joints. Every third finger joint is the
            first of three axes, and the origin of its link frame is that of the joint.
    """
    return [WRIST_LINK, *joints[BASE_JOINTS::3]]


class HandTrajectory:
    """Joint trajectory of a human hand that tracks its reference without contact.

    Args:
        tree: Kinematic tree of the hand.
        config: Motors of the hand's joints.
        start: Reference motion of one row: the initial state of the hand.

    Attributes:
        tree: Kinematic tree of the hand.
    """

    def __init__(self, tree: KinematicTree, config: HandConfig, start: ReferenceMotion) -> None:
        self.tree = tree
        self._motors = list_hand_motors(config)
        self._motor_model: MotorModel | None = None
        # Observations often read a hand at rest: the joints and keypoints of the last call.
        self._cached_keypoints: tuple[Array, npt.NDArray[np.float32]] | None = None
        # One row more than the reference has; the first is the state before it.
        self._joints, self._present = np.zeros((1, HAND_DOF)), np.zeros(1, dtype=bool)
        set_hand_references([self], [start])
        self._joints, self._present = self._joints[-1:], self._present[-1:]

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Compute the hand's joint positions in all steps of a new reference motion."""
        set_hand_references([self], [motion])

    def start_tracking(self, motion: ReferenceMotion) -> list[tuple[MotorModel, slice]]:
        """Return the motor models that track a hand's motion, each with the rows that it tracks.

        Each period in which the hand is present has its own model.
        """
        present, tracked = motion.hand_present, []
        cuts = (np.flatnonzero(np.diff(present)) + 1).tolist()
        for first, last in zip([0, *cuts], [*cuts, len(present)], strict=True):
            if not present[first]:
                self._motor_model = None
                continue
            if self._motor_model is None:
                # A hand appears at its target.
                self._motor_model = MotorModel(self._motors, motion.hand[first])
            tracked.append((self._motor_model, slice(first, last)))
        return tracked

    def finish_tracking(self, motion: ReferenceMotion, tracked: Sequence[tuple[MotorModel, slice]]) -> None:
        """Join the computed trajectories of the motor models to the hand's trajectory.

        Args:
            motion: Reference motion of the hand.
            tracked: Motor models and rows as returned by `start_tracking`, with computed trajectories.
        """
        joints = np.zeros((len(motion.hand_present) + 1, HAND_DOF))
        joints[0] = self._joints[-1]
        for model, rows in tracked:
            joints[rows.start + 1 : rows.stop + 1] = model.trajectory
        self._joints = joints
        self._present = np.concatenate([self._present[-1:], motion.hand_present])

    def predict_positions(self, row: int) -> Array:
        """Predict the wrist positions (n - row, 3) after each step from `row` on (m).

        The reference motion has n steps. Positions are inf while the hand is absent.
        """
        return np.where(self._present[row + 1 :, None], self._joints[row + 1 :, :3], np.inf)

    def get_trajectory(self, row: int) -> tuple[Array, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return the trajectory of the hand in the m steps from `row` of the reference motion on.

        Returns:
            Joint positions (m, 51) after each step (m, rad); whether the hand is present after it (m,);
            and whether the hand moves, appears or disappears in it (m,).
        """
        joints, present = self._joints[row:], self._present[row:]
        changes = (joints[1:] != joints[:-1]).any(axis=1) | (present[1:] != present[:-1])
        return joints[1:], present[1:], changes

    def is_present_after(self, row: int) -> bool:
        """Return whether the hand is in the scene after step `row` of the reference motion.

        Row -1 is the state before the first step.
        """
        return bool(self._present[row + 1])

    def get_joints(self, row: int) -> Array:
        """Return the hand's joints (51,) after step `row` of the reference motion (m, rad).

        Row -1 is the state before the first step.
        """
        joints: Array = self._joints[row + 1]
        return joints

    def get_joints_float32(self, row: int) -> npt.NDArray[np.float32]:
        """Return the hand's joints (51,) after step `row` of the reference, float32 (m, rad).

        Row -1 is the state before the first step.
        """
        return self.get_joints(row).astype(np.float32)

    def compute_keypoints(self, row: int) -> npt.NDArray[np.float32]:
        """Return the hand's keypoints (16, 3) after step `row` of the reference, float32 (m).

        The keypoints are the world positions of the wrist and of 15 finger joints. Row -1 is the
        state before the first step.
        """
        joints = self.get_joints(row)
        if self._cached_keypoints is None or not np.array_equal(joints, self._cached_keypoints[0]):
            origins, _ = self.tree.compute_link_frames(joints[None])
            links = select_keypoint_links(self.tree.moving_links)
            self._cached_keypoints = joints, origins[0, links].astype(np.float32)
        keypoints: npt.NDArray[np.float32] = self._cached_keypoints[1].copy()
        return keypoints


def set_hand_references(hands: Sequence[HandTrajectory], motions: Sequence[ReferenceMotion]) -> None:
    """Set the reference motions of several hands, and compute the hands' trajectories.

    Args:
        hands: Trajectories of the hands.
        motions: Reference motion of each hand.
    """
    tracked: list[list[tuple[MotorModel, slice]]] = []
    for hand, motion in zip(hands, motions, strict=True):
        tracked.append(hand.start_tracking(motion))
    models = [model for own in tracked for model, _ in own]
    targets = [motion.hand[rows] for own, motion in zip(tracked, motions, strict=True) for _, rows in own]
    simulate_motors(models, targets)
    for hand, motion, own in zip(hands, motions, tracked, strict=True):
        hand.finish_tracking(motion, own)


class ObjectTrajectory:
    """Joint trajectory of an object that tracks its reference without contact.

    Args:
        config: Motors of the object's joints.
        start: Initial joint positions (6,): xyz (m) and Euler angles (rad).

    Attributes:
        motor_model: Motor model of the object's six joints.
    """

    def __init__(self, config: ObjectConfig, start: npt.NDArray[np.float32]) -> None:
        self.motor_model = MotorModel(list_object_motors(config), start)
        # Two rows more than the reference has. Before the first step the object is at rest.
        self._joints = np.stack([self.motor_model.position] * 2)

    def set_reference(self, targets: npt.NDArray[np.float32]) -> None:
        """Compute the object's joint positions in n coming steps for joint targets (n, 6)."""
        set_object_references([self], [targets])

    def extend(self) -> None:
        """Append the motor model's trajectory in the new reference motion to the trajectory.

        Of the trajectory so far only the last two rows are kept, the states after the last two steps.
        """
        self._joints = np.concatenate([self._joints[-2:], self.motor_model.trajectory])

    def predict_positions(self, row: int) -> Array:
        """Predict the world positions (n - row, 3) of the object's origin from step `row` on (m).

        The positions are those after each step; the reference motion has n steps.
        """
        return self._joints[row + 2 :, :3]

    def get_joints(self, row: int) -> Array:
        """Return the object's joints (6,) after step `row` of the reference motion (m, rad).

        Rows -1 and -2 are the states after the last two steps before the reference motion.
        """
        joints: Array = self._joints[row + 2]
        return joints

    def compute_velocities(self, row: int) -> Array:
        """Return the object's mean joint velocities (6,) in step `row` (m/s, rad/s).

        Step 0 is the first of the current reference motion, row -1 the step before.
        """
        velocities: Array = (self.get_joints(row) - self.get_joints(row - 1)) / TIME_STEP
        return velocities


def set_object_references(objects: Sequence[ObjectTrajectory], targets: Sequence[npt.NDArray[np.float32]]) -> None:
    """Set the joint targets of several objects for n coming steps, and compute their trajectories.

    Args:
        objects: Trajectories of the objects.
        targets: (n, 6) joint targets of each object (m, rad).
    """
    simulate_motors([item.motor_model for item in objects], targets)
    for item in objects:
        item.extend()
