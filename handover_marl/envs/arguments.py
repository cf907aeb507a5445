"""Names of the environment's agents, and checks of arguments of `reset` and `step`."""

import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.spaces import check_giver_action, check_receiver_action
from handover_marl.errors import ActionError, OptionError, SceneError

GIVER, RECEIVER = "giver", "receiver"
AGENTS = (GIVER, RECEIVER)


def has_display() -> bool:
    """Return whether a screen is available on which a window can be opened.

    Without a screen "human" must not be offered as a render mode, since API checkers try all modes.
    """
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def check_actions(actions: Any, giver_space: spaces.Box) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Check the actions of both agents; return the receiver's (9,) and the giver's (8,), clipped, as float32.

    Raises:
        ActionError: `actions` is not a mapping, names an unknown agent, or an action is missing or malformed.
    """
    if not isinstance(actions, Mapping):
        raise ActionError(f"actions must be a dict by agent, got {type(actions).__name__}")
    unknown = sorted(map(str, actions.keys() - set(AGENTS)))
    if unknown:
        raise ActionError(f"actions must be for {' and '.join(AGENTS)}, got one for {unknown[0]!r}")
    giver_action = check_giver_action(actions.get(GIVER), giver_space)
    return check_receiver_action(actions.get(RECEIVER)), giver_action


def check_scene_option(options: Any, scene_ids: Sequence[int], split_name: str) -> int | None:
    """Return the scene number that the options of `reset` choose, or None if they choose none.

    Unknown options, which API checkers pass, cause a warning, but an error if "scene" is in their name. Errors name the
    set of the valid `scene_ids`, ascending, as `split_name`.

    Raises:
        OptionError: `options` is not a mapping, or has a key with "scene" in it other than `scene_id`.
        SceneError: The scene is not among `scene_ids`.
    """
    if not isinstance(options, Mapping):
        raise OptionError(f"options must be a dict, got {type(options).__name__}")
    unknown = sorted(map(str, options.keys() - {"scene_id"}))
    if any("scene" in key.lower() for key in unknown):
        raise OptionError(f"options of reset() must have the number of the scene as 'scene_id', got {unknown}")
    if unknown:
        warnings.warn(f"unknown options of reset(): {', '.join(unknown)}; valid: scene_id", stacklevel=4)
    scene_id = options.get("scene_id")
    if scene_id is None:
        return None
    if not isinstance(scene_id, (int, np.integer)) or scene_id not in scene_ids:
        raise SceneError(
            f"scene_id must be one of the {len(scene_ids)} scenes of {split_name}, {scene_ids[0]} to "
            f"{scene_ids[-1]}, got {scene_id!r}; env.scene_ids lists them"
        )
    return int(scene_id)
