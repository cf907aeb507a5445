"""Checking what environments are made with."""

import os
import sys

import numpy as np

from handover_marl.config import TIME_STEP
from handover_marl.errors import OptionError


def has_screen() -> bool:
    """Whether there is a screen that a window could open on; checkers open one if it is said that it can be done."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def control_steps(control_period: float) -> int:
    """Physics steps in a control period (s).

    Raises:
        OptionError: It is not a whole number of milliseconds, or none at all, or longer than an hour.
    """
    try:
        steps = 0 if isinstance(control_period, bool) else round(control_period / TIME_STEP)
    except (TypeError, ValueError, OverflowError):
        steps = 0
    if not 1 <= steps <= 3_600_000 or abs(steps * TIME_STEP - control_period) > 1e-9:
        raise OptionError(
            f"control_period={control_period!r} must be a whole number of milliseconds given in seconds, "
            "such as 0.1 or 0.001"
        )
    return steps


def checked_cycles(max_cycles: int | None) -> int | None:
    """How many steps an episode may have, or None.

    Raises:
        OptionError: It is no whole number of at least one.
    """
    if max_cycles is None:
        return None
    if isinstance(max_cycles, bool) or not isinstance(max_cycles, (int, np.integer)) or max_cycles < 1:
        raise OptionError(f"max_cycles={max_cycles!r} must be a whole number, 1 or more, or None")
    return int(max_cycles)
