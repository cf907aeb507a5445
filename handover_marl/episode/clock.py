"""When a policy is asked."""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP
from handover_marl.episode.observations import Observation
from handover_marl.errors import HandoverError, OptionError, PolicyError

Action = npt.NDArray[np.float32]

_NEVER = 2**62


class Player(Protocol):
    """What is asked of a policy while an episode is played; see `handover_marl.policies.policy.Policy`."""

    @property
    def name(self) -> str:
        """What it is called."""

    def prepare(self, object_names: Sequence[str]) -> None:
        """Get ready for episodes with these objects."""

    def reset(self, seed: int | None = None) -> None:
        """Forget the last episode."""

    def act(self, observation: Observation) -> Action:
        """Decide on an action."""

    @property
    def hold_time(self) -> float:
        """How long (s) the last action stands."""


class PolicyClock:
    """Asks a policy when it wants to be asked and repeats its last action in between.

    Args:
        policy: Whom to ask.

    Attributes:
        due: The physics step from which on the policy wants to be asked again.
    """

    def __init__(self, policy: Player) -> None:
        self._policy = policy
        self._action: Action | None = None
        self.due = 0

    def reset(self, seed: int | None, object_names: Sequence[str] = ()) -> None:
        """Start an episode with these objects.

        Raises:
            PolicyError: The policy fails.
        """
        try:
            self._policy.prepare(object_names)
            self._policy.reset(seed)
        except HandoverError:
            raise
        except (Exception, SystemExit) as error:
            raise self._failed("reset", error) from error
        self._action, self.due = None, 0

    def act(self, observe: Callable[[], Observation], step: int) -> Action:
        """The action for now, fresh or repeated.

        Args:
            observe: Gives what the policy sees; called only when it is asked.
            step: Physics steps since the start.

        Raises:
            PolicyError, OptionError: As `ask`.
        """
        if self._action is None or step >= self.due:
            return self.ask(observe(), step)
        return self._action

    def ask(self, observation: Observation, step: int) -> Action:
        """Ask the policy whether it is due or not.

        Raises:
            PolicyError: It fails.
            OptionError: It wants its action held for no time at all.
        """
        try:
            self._action = self._policy.act(observation)
            hold_time = self._policy.hold_time
        except HandoverError:
            raise
        except (Exception, SystemExit) as error:
            raise self._failed(f"after {step} steps", error) from error
        self.due = step + held_steps(hold_time)
        return self._action

    def _failed(self, when: str, error: BaseException) -> PolicyError:
        return PolicyError(f"policy {self._policy.name!r} failed ({when}): {type(error).__name__}: {error}")


def held_steps(hold_time: float) -> int:
    """Physics steps that an action is held for; at least one, practically for ever if the time is infinite.

    Raises:
        OptionError: The time (s) is no positive number.
    """
    if isinstance(hold_time, (bool, str)) or not isinstance(hold_time, (int, float, np.number)) or not hold_time > 0:
        raise OptionError(f"hold_time is {hold_time!r}; it must be a positive number (s)")
    return max(1, round(hold_time / TIME_STEP)) if math.isfinite(hold_time) and hold_time < 1e9 else _NEVER
