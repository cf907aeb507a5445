"""Checking what environments are made with, reset with and stepped with."""

import operator
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import TIME_STEP
from handover_marl.episode.spaces import check_giver_action, check_receiver_action
from handover_marl.errors import ActionError, OptionError, SceneError

GIVER, RECEIVER = "giver", "receiver"
AGENTS = (GIVER, RECEIVER)


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


def checked_actions(actions: Any, giver_space: spaces.Box) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The receiver's and the giver's action from a dict by agent.

    Raises:
        ActionError: It is no such dict, or an action in it is malformed.
    """
    if not isinstance(actions, Mapping):
        raise ActionError(f"step() takes a dict of actions by agent, not {type(actions).__name__}")
    unknown = sorted(map(str, actions.keys() - set(AGENTS)))
    if unknown:
        raise ActionError(f"there is no agent {unknown[0]!r}; actions are for {' and '.join(AGENTS)}")
    deviation = check_giver_action(actions.get(GIVER), giver_space)
    return check_receiver_action(actions.get(RECEIVER)), deviation


def checked_scene(options: Any, scene_ids: Sequence[int], where: str) -> int | None:
    """The scene that options of `reset` choose, or None.

    Args:
        options: The options.
        scene_ids: What may be chosen, ascending.
        where: What to call these in errors.

    Raises:
        OptionError: The options are no dict.
        SceneError: The scene is none of these.
    """
    if not isinstance(options, Mapping):
        raise OptionError(f"reset() takes options as a dict, not {type(options).__name__}")
    unknown = sorted(map(str, options.keys() - {"scene_id"}))
    if unknown:
        warnings.warn(f"reset() knows no option {', '.join(unknown)}; valid: scene_id", stacklevel=4)
    scene_id = options.get("scene_id")
    if scene_id is None:
        return None
    try:
        chosen = operator.index(scene_id)
    except TypeError:
        chosen = -1
    if chosen not in scene_ids:
        raise SceneError(
            f"scene {scene_id!r} is not in {where}, which has {len(scene_ids)} scenes from {scene_ids[0]} to "
            f"{scene_ids[-1]}; env.scene_ids lists them"
        )
    return chosen
