"""Who works out inverse kinematics for receivers: PyBullet where it is installed, else the library itself.

HandoverSim's baselines ask PyBullet, so that only its answers give their results to the bit.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Union

from handover_marl.config import PandaConfig
from handover_marl.options import pybullet_installed
from handover_marl.planning.hand_solver import HandSolver

if TYPE_CHECKING:
    from handover_marl.sim.bullet.engine_kinematics import EngineKinematics
    from handover_marl.sim.bullet.kinematics import PandaKinematics

#: Has `solve`: joints at a pose, or none.
PoseSolver = Union["PandaKinematics", HandSolver]
#: Has `step_towards`: joints nearer to a pose.
StepSolver = Union["EngineKinematics", HandSolver]


def pose_solver(urdf: Path, config: PandaConfig) -> PoseSolver:
    """Asked until the hand is there.

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
    """Asked once, whether the hand gets there or not.

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
