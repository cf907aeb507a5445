"""The engine's warnings as errors: nothing is reset in silence, and no log is written into the working folder."""

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.errors import SimulationError
from handover_marl.options import pybullet_installed

_WARNINGS = {
    mujoco.mjtWarning.mjWARN_INERTIA: "the inertia of the bodies became singular",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "there were more contacts than its memory holds",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "there were more constraints than its memory holds",
    mujoco.mjtWarning.mjWARN_BADQPOS: "a position is not finite",
    mujoco.mjtWarning.mjWARN_BADQVEL: "a velocity is not finite",
    mujoco.mjtWarning.mjWARN_BADQACC: "an acceleration is not finite",
    mujoco.mjtWarning.mjWARN_BADCTRL: "a servo's target is not finite",
}

# Else warnings go to the console and into a file in the working folder.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda message: None)


def check(batch: Batch, rows: npt.NDArray[np.int32]) -> None:
    """Look whether the engine warned in some rows of a batch.

    Raises:
        SimulationError: It did; the state means nothing any more.
    """
    numbers = batch.warning[rows, :, 1]
    if not numbers.any():
        return
    row = int(numbers.any(axis=1).argmax())
    found = [text for kind, text in _WARNINGS.items() if numbers[row, int(kind)]]
    seconds = float(batch.bind("time")[rows[row]])
    instead = "Play this scene with physics='fast', and" if pybullet_installed() else "Leave this scene out, and"
    raise SimulationError(
        f"MuJoCo's simulation broke down after {seconds:.3f} s: {'; '.join(found) or 'it warned'}. {instead} report it"
    )
