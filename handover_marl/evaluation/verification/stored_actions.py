"""Policy that plays the stored actions of a result file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF, TIME_STEP
from handover_marl.episode.observations import Observation
from handover_marl.errors import ResultsError
from handover_marl.evaluation.results.result_folder import load_result_arrays

Actions = npt.NDArray[np.float32]


class StoredActions:
    """Receiver that plays stored actions, one per physics step, and ignores its observations.

    The last action is held if the episode goes on for longer.

    Args:
        actions: (T, 9) float32 target joint positions, 7 arm (rad) and 2 fingers (m).
    """

    name = "stored actions"
    #: No observation is computed.
    obs_mode = None

    def __init__(self, actions: Actions) -> None:
        changes = 1 + np.flatnonzero(np.any(actions[1:] != actions[:-1], axis=1))
        self._starts: list[int] = [0, *changes.tolist()]
        self._actions = actions
        self._next = 0

    def prepare(self, object_names: Sequence[str]) -> None:
        """Do nothing: stored actions need no preparation."""

    def reset(self, seed: int | None = None) -> None:
        """Return to the first action."""
        self._next = 0

    def act(self, observation: Observation) -> Actions:
        """Return the next action that differs from the last one."""
        action: Actions = self._actions[self._starts[self._next]]
        self._next += 1
        return action

    @property
    def hold_time(self) -> float:
        """Time (s) for which the last action is held: until the next different one."""
        if self._next == len(self._starts):
            return np.inf
        return (self._starts[self._next] - self._starts[self._next - 1]) * TIME_STEP


def read_actions(path: Path, n_steps: int) -> Actions:
    """Read the actions of a result file.

    Args:
        path: Result file.
        n_steps: Number of physics steps of the episode.

    Returns:
        (T, 9) float32 actions, with T = `n_steps`.

    Raises:
        ResultsError: The file holds no finite actions of this shape and type.
    """
    actions = load_result_arrays(path).get("action")
    if actions is None or actions.shape != (n_steps, PANDA_DOF) or actions.dtype.kind != "f":
        found = "none" if actions is None else f"{actions.dtype} {actions.shape}"
        raise ResultsError(f"{path}: action must be float32 of shape ({n_steps}, {PANDA_DOF}), got {found}")
    # HandoverSim applies actions in the precision in which its policies return them.
    actions = actions.astype(np.float32)
    if not np.isfinite(actions).all():
        raise ResultsError(f"{path}: action must be finite in every step")
    return actions
