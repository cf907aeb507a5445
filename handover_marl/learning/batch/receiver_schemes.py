"""Action schemes of many receivers at once; see `handover_marl.learning.receiver_schemes` for their meaning."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import CLOSED, LOWER_LIMITS, OPEN, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.geometry.poses import compute_lengths, multiply_quaternions, rotate_points
from handover_marl.learning.batch.features import rotate_to_world
from handover_marl.learning.batch.schemes import SchemeBatch
from handover_marl.learning.receiver_schemes import CartesianDeltaScheme, GraspServoScheme, JointDeltaScheme
from handover_marl.receivers.grasp_selection import GraspSelectionBatch

Array = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]
Flags = npt.NDArray[np.bool_]

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


class JointPositionBatch(SchemeBatch):
    """Batch of `JointPositionScheme`."""

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        low, high = np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
        return np.asarray(low + (self._outputs[rows] + 1.0) / 2.0 * (high - low), dtype=np.float32)


class JointDeltaBatch(SchemeBatch):
    """Batch of `JointDeltaScheme`."""

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        outputs = self._outputs[rows]
        arm = observation["robot_joint_position"][:, :ARM_DOF] + JointDeltaScheme.step * outputs[:, :ARM_DOF]
        return _joint_targets(arm, outputs[:, ARM_DOF] > 0.0)


class CartesianDeltaBatch(SchemeBatch):
    """Batch of `CartesianDeltaScheme`."""

    def __init__(self, scheme: CartesianDeltaScheme, selection: GraspSelectionBatch, count: int) -> None:
        super().__init__(scheme, selection, count)
        self._scheme = scheme
        self._robot = ArmKinematics(read_tree(scheme.context.panda_urdf))

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        outputs, scheme = self._outputs[rows], self._scheme
        translations, rotations = outputs[:, :3] * scheme.step, outputs[:, 3:6] * scheme.turn
        return self._move(observation, translations, rotations, outputs[:, 6] > 0.0)

    def _move(self, observation: Observation, translations: Array, rotations: Array, closed: Flags) -> Actions:
        """Return joint targets that move hand links by (r, 3) m and (r, 3) rotation vectors in their frames."""
        arm = observation["robot_joint_position"][:, :ARM_DOF].astype(np.float64)
        jacobian, axes = self._robot.compute_hand_jacobians(arm)
        twist = np.concatenate([rotate_to_world(axes, translations), rotate_to_world(axes, rotations)], axis=1)
        gram = np.stack([(jacobian * jacobian[:, row, None]).sum(axis=2) for row in range(6)], axis=1)
        weights = np.linalg.solve(gram + self._scheme.damping**2 * np.eye(6), twist[..., None])
        return _joint_targets(arm + (jacobian * weights).sum(axis=1), closed)


class GraspServoBatch(CartesianDeltaBatch):
    """Batch of `GraspServoScheme`."""

    def __init__(self, scheme: GraspServoScheme, selection: GraspSelectionBatch, count: int) -> None:
        super().__init__(scheme, selection, count)
        self._servo, self._goal = scheme, np.array(scheme.context.protocol.goal_center)
        self._closed = np.zeros(count, dtype=bool)

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode: the gripper is open and the arm waits."""
        super().reset(row)
        self._closed[row] = False

    def set_outputs(self, rows: Rows, outputs: npt.NDArray[np.floating]) -> None:
        """Store new network outputs (r, 7), clipped to [-1, 1]."""
        super().set_outputs(rows, outputs)
        self._closed[rows] |= self._outputs[rows, 6] > self._servo.close_threshold

    def needs_outputs(self, rows: Rows, observation: Observation) -> Flags:
        """Return whether the waiting time is over, in each of r episodes."""
        return np.asarray(observation["time"][:, 0].astype(np.float64) >= self.wait)

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        actions = np.tile(np.array(WAITING_JOINTS, dtype=np.float32), (len(rows), 1))
        acts = np.flatnonzero(self.needs_outputs(rows, observation))
        if len(acts):
            actions[acts] = self._servo_to_grasp(rows[acts], {key: value[acts] for key, value in observation.items()})
        return actions

    def _servo_to_grasp(self, rows: Rows, observation: Observation) -> Actions:
        servo, outputs = self._servo, self._outputs[rows]
        gripper = observation["gripper_pose"].astype(np.float64)
        present = _normalize(gripper[:, 3:])
        position, target = self._find_targets(rows, observation, gripper, present)
        position = position + rotate_points(target, outputs[:, :3] * np.array(servo.shift))
        target = multiply_quaternions(target, Rotation.from_rotvec(outputs[:, 3:6] * servo.tilt).as_quat())
        translation = _limit_norm(rotate_points(present * _CONJUGATE, position - gripper[:, :3]), servo.max_translation)
        rotation = Rotation.from_quat(multiply_quaternions(present * _CONJUGATE, target)).as_rotvec()
        return self._move(observation, translation, _limit_norm(rotation, servo.max_rotation), self._closed[rows])

    def _find_targets(
        self, rows: Rows, observation: Observation, gripper: Array, present: Array
    ) -> tuple[Array, Array]:
        """Return the target positions (r, 3) in the world (m) and the target orientations (r, 4)."""
        grasps, _, exists = self._selection.select(rows, observation)
        orientation = _normalize(np.where(exists[:, None], grasps[:, 3:], present))
        standoff = self._compute_standoffs(gripper[:, :3] - grasps[:, :3], present, orientation)
        along = np.stack([np.zeros(len(rows)), np.zeros(len(rows)), standoff], axis=1)
        position = grasps[:, :3] - rotate_points(orientation, along)
        released = observation["released"] != 0.0
        position = np.where(exists[:, None], position, gripper[:, :3])
        return np.where(released, self._goal, position), np.where(released, present, orientation)

    def _compute_standoffs(self, offsets: Array, present: Array, target: Array) -> Array:
        """Return the standoffs (r,) in m for offsets (r, 3) from the grasps (m, world frame)."""
        servo = self._servo
        local = rotate_points(target * _CONJUGATE, offsets)
        angle = Rotation.from_quat(multiply_quaternions(present * _CONJUGATE, target)).magnitude()
        standoff = servo.standoff_per_offset * np.maximum(0.0, np.hypot(local[:, 0], local[:, 1]) - servo.aligned)
        standoff = standoff + servo.standoff_per_angle * np.maximum(0.0, angle - servo.aligned_angle)
        return np.asarray(np.minimum(standoff, servo.max_standoff))


def _normalize(quaternions: Array) -> Array:
    unit: Array = quaternions / np.sqrt((quaternions**2).sum(axis=-1, keepdims=True))
    return unit


def _limit_norm(vectors: Array, length: float) -> Array:
    norm = compute_lengths(vectors)[:, None]
    return np.where(norm <= length, vectors, vectors * (length / np.maximum(norm, length)))


def _joint_targets(arm: npt.NDArray[np.floating], closed: Flags) -> Actions:
    clipped = np.clip(arm, LOWER_LIMITS[:ARM_DOF], UPPER_LIMITS[:ARM_DOF])
    fingers = np.where(closed, CLOSED, OPEN)[:, None]
    return np.concatenate([clipped, fingers, fingers], axis=1).astype(np.float32)
