"""The arm under GA-DDPG's decisions without physics: one call of inverse kinematics each, and a motor that lags."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS
from handover_marl.models.panda import OPEN
from handover_marl.models.poses import compose
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.solvers import step_solver

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LagConfig:
    """How the motors follow.

    Attributes:
        covered: Share of the way to its target that a joint covers in one decision: of 150 steps with a gain of 0.01.
    """

    covered: float = 1.0 - 0.99**150


class KinematicArm:
    """Moves by steps as GA-DDPG's receiver commands them.

    Args:
        context: The robot.
        config: How the motors follow.

    Raises:
        SimulationError: The robot's model cannot be loaded.
    """

    def __init__(self, context: PolicyContext, config: LagConfig | None = None) -> None:
        #: Where the hand is, and its inverse kinematics within the limits.
        self.arm = ArmInWorld.of_panda(context.panda_urdf, context.panda)
        self._engine = step_solver(context.panda_urdf, context.panda)
        self._config = config or LagConfig()

    def moved(self, joints: Array, step: Array) -> Array:
        """Arm joints (7,) one decision later.

        Args:
            joints: (7,) where the arm is (rad).
            step: (6,) translation (m) and Euler angles (rad) about x, y, z, axes at rest, in the hand's frame.
        """
        turned = Rotation.from_euler("xyz", step[3:]).as_quat()
        target = compose(self.arm.hand(joints), np.concatenate([step[:3], turned]))
        found = self._engine.step_towards([*joints, OPEN, OPEN], target[:3], target[3:])[:ARM_JOINTS]
        return np.clip(joints + self._config.covered * (found - joints), *self.arm.limits)
