"""Action schemes for receivers."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF, PandaConfig
from handover_marl.kinematic_tree import KinematicTree
from handover_marl.learning.scheme import Action, ActionScheme, Raw
from handover_marl.observations import Observation
from handover_marl.receivers.base import WAITING_JOINTS

Array = npt.NDArray[np.float64]

_ARM = 7
_OPEN = 0.04  # m, target of each finger


class ReceiverRaw(Raw):
    """The receiver's Box(9) as it is: target joint positions (rad, m)."""

    name, agent, size = "receiver", "receiver", PANDA_DOF


class Joints(ActionScheme):
    """Target joint positions, each scaled from -1 and 1 to the joint's limits."""

    name, agent, size = "joints", "receiver", PANDA_DOF

    def action(self, observation: Observation) -> Action:
        """The outputs within the limits."""
        low, high = np.array(PandaConfig().lower_limits), np.array(PandaConfig().upper_limits)
        return np.asarray(low + (self._outputs + 1.0) / 2.0 * (high - low), dtype=np.float32)


class JointDelta(ActionScheme):
    """Seven changes of the arm joints, at 1 by 0.2 rad from where they are, and the gripper: above 0 it closes."""

    name, agent, size = "joint_delta", "receiver", _ARM + 1
    step = 0.2  # rad

    def action(self, observation: Observation) -> Action:
        """Targets within the joint limits."""
        arm = observation["robot_joint_position"][:_ARM] + self.step * self._outputs[:_ARM]
        return _targets(arm, self._outputs[_ARM])


class CartesianDelta(ActionScheme):
    """Moves the gripper in its own frame: by 0.08 m and 0.3 rad at 1, from where it is; the last output closes it.

    By damped least squares on the Jacobian, so that singular and unreachable poses are approached, not refused.
    The motors make 63 % of a way in 0.1 s.

    Args:
        tree: The Panda's kinematics.
    """

    name, agent, size = "cartesian_delta", "receiver", 7
    step, turn, damping = 0.08, 0.3, 0.05  # m, rad, 1

    def __init__(self, tree: KinematicTree) -> None:
        self._tree = tree
        self._link = [joint.link for joint in tree.joints].index("panda_hand")

    def action(self, observation: Observation) -> Action:
        """Targets within the joint limits."""
        arm = observation["robot_joint_position"].astype(np.float64)
        jacobian, axes = self._jacobian(arm)
        way = np.concatenate([axes @ self._outputs[:3] * self.step, axes @ self._outputs[3:6] * self.turn])
        gram = jacobian @ jacobian.T + self.damping**2 * np.eye(6)
        change = jacobian.T @ np.linalg.solve(gram, way)
        return _targets(arm[:_ARM] + change, self._outputs[6])

    def _jacobian(self, joints: Array) -> tuple[Array, Array]:
        """(6, 7) of the hand link in the base's frame, and the (3, 3) hand link's axes there."""
        origins, rotations = (value[0] for value in self._tree.frames(joints[None]))
        links = self._tree.turning_joints(self._link)
        axes = np.stack([rotations[link] @ self._tree.joints[link].axis for link in links])
        levers = origins[self._link] - origins[links]
        return np.concatenate([np.cross(axes, levers), axes], axis=1).T, rotations[self._link]


class WaitThenCartesian(CartesianDelta):
    """Stays at the waiting pose for two seconds, while the person brings the object; then as `CartesianDelta`."""

    name = "wait_then_cartesian"
    wait = 2.0  # s

    def asks(self, observation: Observation) -> bool:
        """Once the wait is over."""
        return float(observation["time"][0]) >= self.wait

    def action(self, observation: Observation) -> Action:
        """The waiting pose, or targets within the joint limits."""
        if not self.asks(observation):
            return np.array(WAITING_JOINTS, dtype=np.float32)
        return super().action(observation)


def _targets(arm: npt.NDArray[np.floating], gripper: float) -> Action:
    panda = PandaConfig()
    inside = np.clip(arm, panda.lower_limits[:_ARM], panda.upper_limits[:_ARM])
    finger = 0.0 if gripper > 0.0 else _OPEN
    return np.array([*inside, finger, finger], dtype=np.float32)
