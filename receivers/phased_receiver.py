"""Base class of receivers that wait, move in steps, close the fingers and retreat, each for a fixed time."""

import math
from abc import abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import CLOSED
from handover_marl.policies.policy import Action, PolicyContext, Receiver, milliseconds_from_wait

# Times as in HandoverSim (ms): at the start or waiting pose, and while the fingers close.
_WAIT_MS, CLOSE_MS = 3000, 500
#: Distance between waypoints on the straight path to the goal (m).
RETREAT_STEP = 0.03


class PhasedReceiver(Receiver):
    """Base class of receivers whose wait and steps have fixed durations, counted in whole milliseconds.

    Args:
        context: The robot and the task.
        wait: Time at the start or waiting pose (s); default: 3, as in HandoverSim.
    """

    #: Time for which each decision or waypoint is commanded (ms).
    step_ms: ClassVar[int]

    def __init__(self, context: PolicyContext, wait: float | None) -> None:
        super().__init__(context)
        self._wait_ms = _WAIT_MS if wait is None else milliseconds_from_wait(wait)
        self._reset_timing()

    def _reset_timing(self) -> None:
        """Reset the times and the path of the retreat, at the start of an episode."""
        self._now_ms, self._until_ms = 0, math.inf
        self._retreat: list[npt.NDArray[np.float64]] = []

    @property
    def wait(self) -> float:
        """Time at the start or waiting pose (s)."""
        return self._wait_ms / 1000.0

    @property
    def hold_time(self) -> float:
        """Time until the next command or decision (s), infinite after the last one."""
        return (self._until_ms - self._now_ms) / 1000.0

    def _command(self, arm: npt.NDArray[np.float64], fingers: float, until_ms: float) -> Action:
        self._until_ms = until_ms
        return np.array([*arm[:ARM_DOF], fingers, fingers], dtype=np.float32)

    def _carry(self, observation: Observation, start_ms: int) -> Action:
        """Return the present action of the retreat that began at `start_ms` (ms); the first call plans the path."""
        if not self._retreat:
            self._retreat = self._plan_retreat(observation)
        number, last = (self._now_ms - start_ms) // self.step_ms, len(self._retreat) - 1
        until_ms = start_ms + (number + 1) * self.step_ms if number < last else math.inf
        return self._command(self._retreat[min(number, last)], CLOSED, until_ms)

    @abstractmethod
    def _plan_retreat(self, observation: Observation) -> list[npt.NDArray[np.float64]]:
        """Return configurations, arm joints (rad) first, on the straight line to the goal, one for each `step_ms`."""
