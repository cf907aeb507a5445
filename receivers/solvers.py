"""Who works out inverse kinematics for receivers: PyBullet where it is installed, else the library itself.

HandoverSim's baselines ask PyBullet, so that only its answers give their results to the bit.
"""

from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig
from handover_marl.options import pybullet_installed
from handover_marl.planning.hand_solver import HandSolver

Array = npt.NDArray[np.float64]


class PoseSolver(Protocol):
    """Is asked until the hand is there; see `HandSolver.solve`."""

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array | None:
        """Arm joints (7,) that bring the hand link to a pose, or None."""


class StepSolver(Protocol):
    """Is asked once, whether the hand gets there or not; see `HandSolver`."""

    def step_towards(self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: Array | None = None) -> Array:
        """Joints (9,) from which the hand link is at a pose, or nearer to it."""

    def in_base(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """A world pose (7,) in the robot's base frame."""

    def in_world(self, base_from_hand: Array) -> Array:
        """A pose (7,) in the robot's base frame as a world pose."""


def pose_solver(urdf: Path, config: PandaConfig) -> PoseSolver:
    """Inverse kinematics for who wants an answer that is there, or none.

    Args:
        urdf: The Panda's model file.
        config: Where the Panda stands.

    Raises:
        SimulationError: The model cannot be read.
    """
    if not pybullet_installed():
        return HandSolver(urdf, config)
    from handover_marl.sim.bullet.kinematics import PandaKinematics

    return PandaKinematics(urdf, config)


def step_solver(urdf: Path, config: PandaConfig) -> StepSolver:
    """Inverse kinematics for who takes whatever one question brings.

    Args:
        urdf: The Panda's model file.
        config: Where the Panda stands.

    Raises:
        SimulationError: The model cannot be read.
    """
    if not pybullet_installed():
        return HandSolver(urdf, config)
    from handover_marl.sim.bullet.engine_kinematics import EngineKinematics

    return EngineKinematics(urdf, config)
