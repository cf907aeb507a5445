"""Action schemes of many receivers at once; see `handover_marl.learning.receiver_schemes` for their meaning."""

import numpy as np

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, get_namespace, stack_last
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import CLOSED, LOWER_LIMITS, OPEN, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.geometry.poses import (
    compute_lengths,
    conjugate_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    rotate_points,
)
from handover_marl.geometry.rotations import (
    compute_rotation_magnitudes,
    quaternions_from_rotation_vectors,
    rotation_vectors_from_quaternions,
)
from handover_marl.learning.action_scheme import ActionScheme
from handover_marl.learning.batch.features import rotate_to_world
from handover_marl.learning.batch.grasp_selector import LowestCostGraspSelectorBatch
from handover_marl.learning.batch.schemes import SchemeBatch
from handover_marl.learning.receiver_schemes import CartesianDeltaScheme, GraspServoScheme, JointDeltaScheme


class JointSchemeBatch(SchemeBatch):
    """Base class of batches whose actions are target joint positions within the limits."""

    def __init__(
        self,
        scheme: ActionScheme,
        selector: LowestCostGraspSelectorBatch,
        count: int,
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        super().__init__(scheme, selector, count, arrays)
        self._low, self._high = arrays.asarray(LOWER_LIMITS), arrays.asarray(UPPER_LIMITS)

    def _limit_targets(self, arm: AnyArray, closed: AnyArray) -> AnyArray:
        """Return target positions (r, 9) from those of arms (r, 7) in rad and whether grippers close, (r,)."""
        xp = self._arrays.xp
        clipped = arm.clip(self._low[:ARM_DOF], self._high[:ARM_DOF])
        fingers = xp.where(closed, CLOSED, OPEN)[:, None]
        return xp.astype(xp.concat([clipped, fingers, fingers], axis=1), xp.float32)


class JointPositionBatch(JointSchemeBatch):
    """Batch of `JointPositionScheme`."""

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        xp, low = self._arrays.xp, self._low
        return xp.astype(low + (self._outputs[rows] + 1.0) / 2.0 * (self._high - low), xp.float32)


class JointDeltaBatch(JointSchemeBatch):
    """Batch of `JointDeltaScheme`."""

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        outputs = self._outputs[rows]
        arm = observation["robot_joint_position"][:, :ARM_DOF] + JointDeltaScheme.step * outputs[:, :ARM_DOF]
        return self._limit_targets(arm, outputs[:, ARM_DOF] > 0.0)


class CartesianDeltaBatch(JointSchemeBatch):
    """Batch of `CartesianDeltaScheme`."""

    def __init__(
        self,
        scheme: CartesianDeltaScheme,
        selector: LowestCostGraspSelectorBatch,
        count: int,
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        super().__init__(scheme, selector, count, arrays)
        self._scheme, self._damping = scheme, arrays.asarray(scheme.damping**2 * np.eye(6))
        self._max_translation = arrays.asarray(scheme.max_output_translation)
        self._robot = ArmKinematics(read_tree(scheme.context.panda_urdf))

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        outputs = self._outputs[rows]
        translations = outputs[:, :3] * self._max_translation
        rotations = outputs[:, 3:6] * self._scheme.max_output_rotation
        return self._move(observation, translations, rotations, outputs[:, 6] > 0.0)

    def _move(
        self, observation: Observation, translations: AnyArray, rotations: AnyArray, closed: AnyArray
    ) -> AnyArray:
        """Return joint targets that move hand links by (r, 3) m and (r, 3) rotation vectors in their frames."""
        xp = self._arrays.xp
        arm = xp.astype(observation["robot_joint_position"][:, :ARM_DOF], xp.float64)
        jacobian, axes = self._robot.compute_hand_jacobians(arm)
        twist = xp.concat([rotate_to_world(axes, translations), rotate_to_world(axes, rotations)], axis=1)
        gram = xp.stack([xp.sum(jacobian * jacobian[:, row, None], axis=2) for row in range(6)], axis=1)
        weights = xp.linalg.solve(gram + self._damping, twist[..., None])
        return self._limit_targets(arm + xp.sum(jacobian * weights, axis=1), closed)


class GraspServoBatch(CartesianDeltaBatch):
    """Batch of `GraspServoScheme`."""

    def __init__(
        self,
        scheme: GraspServoScheme,
        selector: LowestCostGraspSelectorBatch,
        count: int,
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        super().__init__(scheme, selector, count, arrays)
        self._servo, self._goal = scheme, arrays.asarray(scheme.context.protocol.goal_center)
        self._waiting = arrays.asarray(WAITING_JOINTS, "float32")
        self._closed = arrays.zeros(count, "bool")

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode: the gripper is open and the arm waits."""
        super().reset(row)
        self._closed[row] = False

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store new network outputs (r, 7), clipped to [-1, 1]."""
        super().set_outputs(rows, outputs)
        self._closed[rows] |= self._outputs[rows, 6] > self._servo.close_threshold

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the waiting time is over, in each of r episodes."""
        xp = self._arrays.xp
        return xp.astype(observation["time"][:, 0], xp.float64) >= self.wait

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m)."""
        xp = self._arrays.xp
        actions = xp.tile(self._waiting, (len(rows), 1))
        acts = xp.nonzero(self.needs_outputs(rows, observation))[0]
        if len(acts):
            actions[acts] = self._servo_to_grasp(rows[acts], {key: value[acts] for key, value in observation.items()})
        return actions

    def _servo_to_grasp(self, rows: AnyArray, observation: Observation) -> AnyArray:
        xp, servo, outputs = self._arrays.xp, self._servo, self._outputs[rows]
        gripper = xp.astype(observation["gripper_pose"], xp.float64)
        present = normalize_quaternions(gripper[:, 3:])
        position, target = self._find_targets(rows, observation, gripper, present)
        position = position + rotate_points(target, outputs[:, :3] * self._max_translation)
        target = multiply_quaternions(
            target, quaternions_from_rotation_vectors(outputs[:, 3:6] * servo.max_output_rotation)
        )
        inverse = conjugate_quaternions(present)
        translation = _limit_norm(rotate_points(inverse, position - gripper[:, :3]), servo.max_translation)
        rotation = rotation_vectors_from_quaternions(multiply_quaternions(inverse, target))
        return self._move(observation, translation, _limit_norm(rotation, servo.max_rotation), self._closed[rows])

    def _find_targets(
        self, rows: AnyArray, observation: Observation, gripper: AnyArray, present: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Return the target positions (r, 3) in the world (m) and the target orientations (r, 4)."""
        xp, (grasps, _, exists) = self._arrays.xp, self._selector.select(rows, observation)
        orientation = normalize_quaternions(xp.where(exists[:, None], grasps[:, 3:], present))
        standoff = self._compute_standoffs(gripper[:, :3] - grasps[:, :3], present, orientation)
        zeros = xp.zeros_like(standoff)
        position = grasps[:, :3] - rotate_points(orientation, stack_last([zeros, zeros, standoff]))
        released = observation["released"] != 0.0
        position = xp.where(exists[:, None], position, gripper[:, :3])
        return xp.where(released, self._goal, position), xp.where(released, present, orientation)

    def _compute_standoffs(self, offsets: AnyArray, present: AnyArray, target: AnyArray) -> AnyArray:
        """Return the standoffs (r,) in m for offsets (r, 3) from the grasps (m, world frame)."""
        xp, servo = self._arrays.xp, self._servo
        local = rotate_points(conjugate_quaternions(target), offsets)
        angle = compute_rotation_magnitudes(multiply_quaternions(conjugate_quaternions(present), target))
        lateral = xp.hypot(local[:, 0], local[:, 1])
        standoff = servo.standoff_per_offset * (lateral - servo.lateral_tolerance).clip(0.0)
        standoff = standoff + servo.standoff_per_angle * (angle - servo.angle_tolerance).clip(0.0)
        return standoff.clip(None, servo.max_standoff)


def _limit_norm(vectors: AnyArray, length: float) -> AnyArray:
    xp, norm = get_namespace(vectors), compute_lengths(vectors)[:, None]
    return xp.where(norm <= length, vectors, vectors * (length / norm.clip(length)))
