"""The two agents' action spaces, and the checking of actions."""

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import PANDA_DOF, PandaConfig
from handover_marl.errors import ActionError

#: Components of the giver's action: playback rate (1), wrist displacement (3), wrist rotation (3), release (1).
GIVER_ACTION_SIZE = 8


def receiver_action_space() -> spaces.Box:
    """Target joint positions: 7 arm joints (rad), 2 fingers (m), within the Panda's limits.

    Actions beyond the bounds are not clipped; motors and joint limits do the bounding, as in HandoverSim.
    """
    panda = PandaConfig()
    return spaces.Box(
        np.array(panda.lower_limits, dtype=np.float32), np.array(panda.upper_limits, dtype=np.float32)
    )


def giver_action_space() -> spaces.Box:
    """Deviation from the replayed motion; its only element is zero, the replay itself."""
    return spaces.Box(0.0, 0.0, (GIVER_ACTION_SIZE,), np.float32)


def check_receiver_action(action: object) -> npt.NDArray[np.float32]:
    """The action rounded to float32.

    Raises:
        ActionError: It is not nine finite numbers.
    """
    return _as_float32("receiver", action, PANDA_DOF, "target joint positions: 7 arm (rad), 2 fingers (m)")


def check_giver_action(action: object) -> npt.NDArray[np.float32]:
    """The action rounded to float32.

    Raises:
        ActionError: It is not eight finite numbers, or not all zero.
    """
    values = _as_float32("giver", action, GIVER_ACTION_SIZE, "the deviation from the replay")
    if values.any():
        raise ActionError("the giver can only replay: its action must be zero in every component")
    return values


def _as_float32(agent: str, action: object, size: int, meaning: str) -> npt.NDArray[np.float32]:
    if action is None:
        raise ActionError(
            f"the {agent} is missing from the actions (or its action is None): pass {size} numbers, {meaning}, "
            f'under the key "{agent}"'
        )
    values = _real_numbers(action)
    if values is None:
        raise ActionError(
            f"the {agent}'s action is not numeric ({type(action).__name__}); expected {size} numbers, {meaning}"
        )
    if values.shape != (size,):
        raise ActionError(f"the {agent}'s action has shape {values.shape}; expected ({size},), {meaning}")
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ActionError(f"the {agent}'s action is not finite: component {bad} is {values[bad]}")
    return values


def _real_numbers(action: object) -> npt.NDArray[np.float32] | None:
    """The action rounded to float32, or None if it is not made of real numbers."""
    try:
        values = np.asarray(action)
    except (TypeError, ValueError, RuntimeError):  # ragged lists; tensors on a GPU or with a gradient
        return None
    if values.dtype.kind not in "biuf":
        return None
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
