"""Action schemes for receivers."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS, PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.learning.scheme import Action, ActionScheme, Outputs, Raw
from handover_marl.models.arm import Arm
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import CLOSED, LOWER_LIMITS, OPEN, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.grasp_choice import grasp_choice

Array = npt.NDArray[np.float64]


class ReceiverRaw(Raw):
    """The receiver's Box(9) as it is: target joint positions (rad, m)."""

    name, agent, size = "receiver", "receiver", PANDA_DOF


class Joints(ActionScheme):
    """Target joint positions, each scaled from -1 and 1 to the joint's limits."""

    name, agent, size = "joints", "receiver", PANDA_DOF

    def action(self, observation: Observation) -> Action:
        """The outputs within the limits."""
        low, high = np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
        return np.asarray(low + (self._outputs + 1.0) / 2.0 * (high - low), dtype=np.float32)


class JointDelta(ActionScheme):
    """Seven changes of the arm joints, at 1 by 0.2 rad from where they are, and the gripper: above 0 it closes."""

    name, agent, size = "joint_delta", "receiver", ARM_JOINTS + 1
    step = 0.2  # rad

    def action(self, observation: Observation) -> Action:
        """Targets within the joint limits."""
        arm = observation["robot_joint_position"][:ARM_JOINTS] + self.step * self._outputs[:ARM_JOINTS]
        return _targets(arm, self._outputs[ARM_JOINTS] > 0.0)


class CartesianDelta(ActionScheme):
    """Moves the gripper in its own frame: by 0.08 m and 0.3 rad at 1, from where it is; the last output closes it.

    By damped least squares on the Jacobian, so that singular and unreachable poses are approached, not refused.
    The motors make 63 % of a way in 0.1 s.
    """

    name, agent, size = "cartesian_delta", "receiver", 7
    step, turn, damping = 0.08, 0.3, 0.05  # m, rad, 1

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self._robot = Arm(read_tree(context.panda_urdf))

    def action(self, observation: Observation) -> Action:
        """Targets within the joint limits."""
        way, turn = self._outputs[:3] * self.step, self._outputs[3:6] * self.turn
        return self._move(observation, way, turn, self._outputs[6] > 0.0)

    def _move(self, observation: Observation, way: Array, turn: Array, closed: bool) -> Action:
        """Targets that move the hand link by (3,) m and turn it by (3,) rad in its own frame."""
        arm = observation["robot_joint_position"][:ARM_JOINTS].astype(np.float64)
        chain = self._robot.chain(arm[None])
        jacobian, axes = self._robot.jacobian(chain)[..., 0], chain.rotations[-1][..., 0]
        gram = jacobian @ jacobian.T + self.damping**2 * np.eye(6)
        change = jacobian.T @ np.linalg.solve(gram, np.concatenate([axes @ way, axes @ turn]))
        return _targets(arm + change, closed)


class GraspServo(CartesianDelta):
    """Goes where a grasp is, less what the outputs say; once the object is let go, to the goal.

    Stays at the waiting pose for two seconds, while the person brings the object. Then it comes to a grasp along
    the grasp's axis: the further it is beside that axis, or turned otherwise, the further it stays back. Outputs
    0-2 shift the target by 0.01, 0.01 and 0.03 m and outputs 3-5 turn it by 0.1 rad, in the target's frame. When
    the last one exceeds 0.5 the gripper closes, for good. So zero goes to the grasp of
    `handover_marl.receivers.grasp_choice` and never closes; what there is to learn is when to close, and how to
    come to it better.
    """

    name = "grasp_servo"
    wait = 2.0  # s
    shift, tilt = (0.01, 0.01, 0.03), 0.1  # m, rad
    firm = 0.5  # output that closes
    fastest, fastest_turn = 0.1, 0.4  # m and rad from where the gripper is
    aligned, aligned_turn = 0.01, 0.15  # m and rad off the axis that need no detour
    back_beside, back_turned, farthest_back = 3.0, 0.3, 0.15  # m/m, m/rad, m

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self._choice = grasp_choice(context)
        self._goal = np.array(context.protocol.goal_center)

    def reset(self) -> None:
        """Wait, open."""
        super().reset()
        self._closed = False

    def decide(self, outputs: Outputs) -> None:
        """Take new outputs."""
        super().decide(outputs)
        self._closed = self._closed or bool(self._outputs[6] > self.firm)

    def asks(self, observation: Observation) -> bool:
        """Once the wait is over."""
        return float(observation["time"][0]) >= self.wait

    def action(self, observation: Observation) -> Action:
        """The waiting pose, or targets within the joint limits."""
        if not self.asks(observation):
            return np.array(WAITING_JOINTS, dtype=np.float32)
        gripper = observation["gripper_pose"].astype(np.float64)
        own = Rotation.from_quat(gripper[3:])
        place, turned = self._target(observation, gripper, own)
        place = place + turned.apply(self._outputs[:3] * np.array(self.shift))
        turned = turned * Rotation.from_rotvec(self._outputs[3:6] * self.tilt)
        way = own.inv().apply(place - gripper[:3])
        turn = (own.inv() * turned).as_rotvec()
        return self._move(observation, _shortened(way, self.fastest), _shortened(turn, self.fastest_turn), self._closed)

    def _detour(self, away: Array, own: Rotation, turned: Rotation) -> float:
        """How far to stay back (m) from a target while beside its axis or turned otherwise."""
        beside = float(np.hypot(*turned.inv().apply(away)[:2]))
        turn = float((own.inv() * turned).magnitude())
        back = self.back_beside * max(0.0, beside - self.aligned)
        return min(back + self.back_turned * max(0.0, turn - self.aligned_turn), self.farthest_back)

    def _target(self, observation: Observation, gripper: Array, own: Rotation) -> tuple[Array, Rotation]:
        if observation["released"][0]:
            return self._goal, own
        chosen = self._choice.choose(observation)
        if chosen is None:
            return gripper[:3], own
        place, turned = chosen[0][:3], Rotation.from_quat(chosen[0][3:])
        return place - turned.apply([0.0, 0.0, self._detour(gripper[:3] - place, own, turned)]), turned


def _shortened(vector: Array, length: float) -> Array:
    size = float(np.linalg.norm(vector))
    return vector if size <= length else vector * (length / size)


def _targets(arm: npt.NDArray[np.floating], closed: bool) -> Action:
    inside = np.clip(arm, LOWER_LIMITS[:ARM_JOINTS], UPPER_LIMITS[:ARM_JOINTS])
    finger = CLOSED if closed else OPEN
    return np.array([*inside, finger, finger], dtype=np.float32)
