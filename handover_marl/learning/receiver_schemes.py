"""Action schemes of receivers, which convert network outputs to joint targets."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import CLOSED, LOWER_LIMITS, OPEN, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.learning.action_scheme import Action, ActionScheme, Outputs, RawScheme
from handover_marl.learning.grasp_selector import get_lowest_cost_grasp_selector
from handover_marl.policies.policy import PolicyContext

Array = npt.NDArray[np.float64]


class RawReceiverScheme(RawScheme):
    """Identity scheme of receivers: the outputs are target joint positions (rad, m)."""

    name, agent, size = "receiver", "receiver", PANDA_DOF


class JointPositionScheme(ActionScheme):
    """Scheme of target joint positions, scaled from [-1, 1] to the joint limits."""

    name, agent, size = "joints", "receiver", PANDA_DOF

    def compute_action(self, observation: Observation) -> Action:
        """Return the target positions (9,) of arm and fingers within the joint limits (rad, m)."""
        low, high = np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
        return np.asarray(low + (self.outputs + 1.0) / 2.0 * (high - low), dtype=np.float32)


class JointDeltaScheme(ActionScheme):
    """Scheme of position increments of the seven arm joints, and an output that closes the gripper.

    The gripper closes while the last output exceeds 0.

    Attributes:
        step: Joint increment at output 1 (rad).
    """

    name, agent, size = "joint_delta", "receiver", ARM_DOF + 1
    step = 0.2

    def compute_action(self, observation: Observation) -> Action:
        """Return the target positions (9,) of arm and fingers within the joint limits (rad, m)."""
        arm = observation["robot_joint_position"][:ARM_DOF] + self.step * self.outputs[:ARM_DOF]
        return _joint_targets(arm, self.outputs[ARM_DOF] > 0.0)


class CartesianDeltaScheme(ActionScheme):
    """Scheme of motions of the hand link in its own frame, and an output that closes the gripper.

    The gripper closes while the last output exceeds 0. Joint increments follow from the motion by
    damped least squares on the Jacobian, so that the arm approaches singular and unreachable poses as
    near as it can. The motors complete 63 % of a motion in 0.1 s.

    Attributes:
        max_output_translation: Translation at output 1 (m).
        max_output_rotation: Rotation at output 1 (rad).
        damping: Damping factor of the least squares.
    """

    name, agent, size = "cartesian_delta", "receiver", 7
    max_output_translation: float | tuple[float, float, float] = 0.08
    max_output_rotation, damping = 0.3, 0.05

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self._robot = ArmKinematics(read_tree(context.panda_urdf))

    def compute_action(self, observation: Observation) -> Action:
        """Return the target positions (9,) of arm and fingers within the joint limits (rad, m)."""
        translation = self.outputs[:3] * np.array(self.max_output_translation)
        rotation = self.outputs[3:6] * self.max_output_rotation
        return self._move(observation, translation, rotation, self.outputs[6] > 0.0)

    def _move(self, observation: Observation, translation: Array, rotation: Array, closed: bool) -> Action:
        """Return joint targets that move the hand link by (3,) m and a (3,) rotation vector in its frame."""
        arm = observation["robot_joint_position"][:ARM_DOF].astype(np.float64)
        chain = self._robot.compute_chain_frames(arm[None])
        jacobian, axes = self._robot.compute_jacobian(chain)[..., 0], chain.rotations[-1][..., 0]
        gram = jacobian @ jacobian.T + self.damping**2 * np.eye(6)
        change = jacobian.T @ np.linalg.solve(gram, np.concatenate([axes @ translation, axes @ rotation]))
        return _joint_targets(arm + change, closed)


class GraspServoScheme(CartesianDeltaScheme):
    """Scheme that moves to the known grasp of lowest cost, which the outputs correct, and then to the goal.

    The arm stays at the waiting pose during `wait`. Then it approaches the grasp chosen by
    `handover_marl.learning.grasp_selector` along the grasp's z axis: the farther the gripper is from
    this axis or from the grasp's orientation, the longer the standoff. After the release it moves the
    gripper to the goal. With zero outputs the gripper never closes, so that the policy has to learn
    when to close and how to correct the approach. The target is the grasp or its standoff pose.

    | outputs | meaning at 1, in the frame of the target |
    |---|---|
    | 0-2 | translation of the target by 0.01, 0.01 and 0.03 m |
    | 3-5 | rotation of the target by 0.1 rad about each axis |
    | 6 | above 0.5 the gripper closes until the end of the episode |

    Attributes:
        max_output_translation: Translation of the target at output 1, along each axis (m).
        max_output_rotation: Rotation of the target at output 1 (rad).
        close_threshold: Output above which the gripper closes.
        max_translation: Largest distance of the commanded from the present gripper position (m).
        max_rotation: Largest angle between commanded and present gripper orientation (rad).
        lateral_tolerance: Distance of the gripper from the grasp's z axis up to which no standoff is needed (m).
        angle_tolerance: Angle to the grasp's orientation up to which no standoff is needed (rad).
        standoff_per_offset: Increase of the standoff per distance beyond `lateral_tolerance` (m/m).
        standoff_per_angle: Increase of the standoff per angle beyond `angle_tolerance` (m/rad).
        max_standoff: Largest distance of the standoff pose from the grasp (m).
    """

    name = "grasp_servo"
    wait = 2.0
    max_output_translation, max_output_rotation = (0.01, 0.01, 0.03), 0.1
    close_threshold = 0.5
    max_translation, max_rotation = 0.1, 0.4
    lateral_tolerance, angle_tolerance = 0.01, 0.15
    standoff_per_offset, standoff_per_angle, max_standoff = 3.0, 0.3, 0.15

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self._grasp_selector = get_lowest_cost_grasp_selector(context)
        self._goal = np.array(context.protocol.goal_center)

    def reset(self) -> None:
        """Clear the state of the previous episode: the gripper is open and the arm waits."""
        super().reset()
        self._closed = False

    def set_outputs(self, outputs: Outputs) -> None:
        """Store new network outputs (7,), clipped to [-1, 1]."""
        super().set_outputs(outputs)
        self._closed = self._closed or bool(self.outputs[6] > self.close_threshold)

    def needs_outputs(self, observation: Observation) -> bool:
        """Return whether the waiting time is over."""
        return float(observation["time"][0]) >= self.wait

    def compute_action(self, observation: Observation) -> Action:
        """Return the target positions (9,) of arm and fingers within the joint limits (rad, m)."""
        if not self.needs_outputs(observation):
            return np.array(WAITING_JOINTS, dtype=np.float32)
        gripper = observation["gripper_pose"].astype(np.float64)
        present = Rotation.from_quat(gripper[3:])
        position, target = self._target(observation, gripper, present)
        position = position + target.apply(self.outputs[:3] * np.array(self.max_output_translation))
        target = target * Rotation.from_rotvec(self.outputs[3:6] * self.max_output_rotation)
        translation = _limit_norm(present.inv().apply(position - gripper[:3]), self.max_translation)
        rotation = _limit_norm((present.inv() * target).as_rotvec(), self.max_rotation)
        return self._move(observation, translation, rotation, self._closed)

    def _target(self, observation: Observation, gripper: Array, present: Rotation) -> tuple[Array, Rotation]:
        """Return the target position (3,) in the world (m) and the target orientation."""
        if observation["released"][0]:
            return self._goal, present
        chosen = self._grasp_selector.select(observation)
        if chosen is None:
            return gripper[:3], present
        position, target = chosen[0][:3], Rotation.from_quat(chosen[0][3:])
        standoff = self._standoff(gripper[:3] - position, present, target)
        return position - target.apply([0.0, 0.0, standoff]), target

    def _standoff(self, offset: Array, present: Rotation, target: Rotation) -> float:
        """Return the standoff (m) for an offset (3,) from the grasp (m, world frame)."""
        lateral = float(np.hypot(*target.inv().apply(offset)[:2]))
        angle = float((present.inv() * target).magnitude())
        standoff = self.standoff_per_offset * max(0.0, lateral - self.lateral_tolerance)
        return min(standoff + self.standoff_per_angle * max(0.0, angle - self.angle_tolerance), self.max_standoff)


def _limit_norm(vector: Array, length: float) -> Array:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)


def _joint_targets(arm: npt.NDArray[np.floating], closed: bool) -> Action:
    clipped = np.clip(arm, LOWER_LIMITS[:ARM_DOF], UPPER_LIMITS[:ARM_DOF])
    finger = CLOSED if closed else OPEN
    return np.array([*clipped, finger, finger], dtype=np.float32)
