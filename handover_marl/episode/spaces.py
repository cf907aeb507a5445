"""The two agents' action spaces, and the checking of actions."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import OFFICIAL, PANDA_DOF, GiverConfig
from handover_marl.errors import ActionError
from handover_marl.models.panda import LOWER_LIMITS, UPPER_LIMITS

#: Components of the giver's action: playback rate (1), wrist displacement (3), wrist rotation (3), release (1).
GIVER_ACTION_SIZE = 8


def receiver_action_space() -> spaces.Box:
    """Target joint positions: 7 arm joints (rad), 2 fingers (m), within the Panda's limits.

    Actions beyond the bounds are not clipped; motors and joint limits do the bounding, as in HandoverSim.
    """
    return spaces.Box(np.array(LOWER_LIMITS, dtype=np.float32), np.array(UPPER_LIMITS, dtype=np.float32))


def giver_action_space(config: GiverConfig = OFFICIAL.giver) -> spaces.Box:
    """Deviation from the replayed motion; zero is the replay itself.

    | components | meaning | bounds |
    |---|---|---|
    | 0 | playback rate less the recorded one: -1 pauses, 1 doubles the speed | -1 to 1 |
    | 1-3 | set-point of the wrist's displacement from the replayed wrist, world frame (m) | -0.3 to 0.3 |
    | 4-6 | set-point of its rotation vector about the wrist, world frame (rad) | -1 to 1 |
    | 7 | above 0.5: let go now | 0 to 1 |

    Actions beyond the bounds are clipped. Set-points are approached at a human pace and count once the object has
    been picked up; see `handover_marl.config.GiverConfig`.
    """
    high = np.array([1.0, *[config.displacement] * 3, *[config.rotation] * 3, 1.0], dtype=np.float32)
    low = -high
    low[-1] = 0.0
    return spaces.Box(low, high)


@dataclass(frozen=True, eq=False)
class GiverAction:
    """The parts of a giver's action.

    Attributes:
        rate: Playback rate less the recorded one.
        displacement: (3,) set-point of the wrist's displacement (m).
        rotation: (3,) set-point of its rotation vector (rad).
        release: Whether to let go now.
    """

    rate: float
    displacement: npt.NDArray[np.float32]
    rotation: npt.NDArray[np.float32]
    release: bool

    @classmethod
    def of(cls, action: npt.NDArray[np.float32]) -> "GiverAction":
        """Read a checked action (8,)."""
        return cls(float(action[0]), action[1:4], action[4:7], bool(action[7] > 0.5))


def check_receiver_action(action: object) -> npt.NDArray[np.float32]:
    """The action rounded to float32.

    Raises:
        ActionError: It is not nine finite numbers.
    """
    return _as_float32("receiver", action, PANDA_DOF, "target joint positions: 7 arm (rad), 2 fingers (m)")


def check_giver_action(action: object, space: spaces.Box) -> npt.NDArray[np.float32]:
    """The action rounded to float32 and clipped to a giver's space.

    Raises:
        ActionError: It is not eight finite numbers.
    """
    values = _as_float32("giver", action, GIVER_ACTION_SIZE, "the deviation from the replay")
    return np.clip(values, space.low, space.high)


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
    if values.dtype == np.float32:
        # Nothing overflows, and to say that it may takes its time.
        rounded: npt.NDArray[np.float32] = values.copy()
        return rounded
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
