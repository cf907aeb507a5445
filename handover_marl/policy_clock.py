"""When a policy is asked."""

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.errors import OptionError
from handover_marl.observations import Observation

_NEVER_MS = 2**62


class Policy(Protocol):
    """What givers and receivers have in common."""

    def reset(self, seed: int | None = None) -> None:
        """Forget the last episode."""

    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        """Decide on an action."""

    @property
    def hold_time(self) -> float:
        """How long (s) the last action stands."""


class PolicyClock:
    """Asks a policy when it wants to be asked and repeats its last action in between.

    Attributes:
        due_ms: Time (ms) from which on the policy wants to be asked again.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._action: npt.NDArray[np.float32] | None = None
        self.due_ms = 0

    def reset(self, seed: int | None) -> None:
        """Start an episode."""
        self._policy.reset(seed)
        self._action, self.due_ms = None, 0

    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        """The action for now, fresh or repeated."""
        now_ms = round(float(observation["time"][0]) * 1000)
        if self._action is None or self.due(now_ms):
            self._action = self.ask(observation)
        return self._action

    def due(self, now_ms: int) -> bool:
        """Whether the policy wants to be asked."""
        return now_ms >= self.due_ms

    def ask(self, observation: Observation) -> npt.NDArray[np.float32]:
        """Ask the policy whether it is due or not.

        Raises:
            OptionError: It wants its action held for no time at all.
        """
        now_ms = round(float(observation["time"][0]) * 1000)
        action = self._policy.act(observation)
        hold_time = self._policy.hold_time
        if not hold_time > 0.0:
            raise OptionError(f"hold_time is {hold_time}; it must be positive (s)")
        self.due_ms = now_ms + max(1, round(hold_time * 1000)) if math.isfinite(hold_time) else _NEVER_MS
        return action
