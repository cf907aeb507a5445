"""Settings of MuJoCo in this process, and its warnings."""

import mujoco
import numpy as np
from mujoco.batch import Batch

from handover_marl.errors import SimulationError
from handover_marl.execution.options import is_pybullet_installed


def configure_engine() -> None:
    """Disable MuJoCo's warning output in this process.

    MuJoCo writes warnings to the console and to a log in the working folder; `check_warnings` reports them
    instead.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda message: None)


def check_warnings(batch: Batch) -> None:
    """Raise an error if MuJoCo warned in the world of a batch.

    Raises:
        SimulationError: There were warnings; the simulated state is invalid.
    """
    details, counts = batch.warning[0].T
    if not counts.any():
        return
    found = [mujoco.mju_warningText(kind, details[kind]) for kind in np.flatnonzero(counts)]
    advice = "run this scene with physics='fast'" if is_pybullet_installed() else "leave this scene out"
    raise SimulationError(f"MuJoCo's simulation failed: {' '.join(found)} To go on, {advice}, and report this.")
