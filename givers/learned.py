"""People as a network learned them."""

import os
from pathlib import Path

from handover_marl.givers.base import Action, Giver
from handover_marl.learning.policy import LearnedPolicy
from handover_marl.learning.policy_files import read_policy
from handover_marl.observations import Observation

#: Trained for the receiver yang2021; the file says how.
SHIPPED = Path(__file__).parent / "policies" / "for_yang2021.npz"


class LearnedGiver(Giver):
    """Does what a trained policy says; the one in the box holds objects out so that `yang2021` can take them.

    Args:
        path: A policy file, see `handover_marl.learning.policy_files`; None takes the one in the box.
        trust: Whether code in the file may run.

    Raises:
        DataNotFoundError, DataFormatError, UnsafeFileError, OptionError: As `read_policy`.
    """

    name = "learned"

    def __init__(self, path: str | os.PathLike[str] | None = None, trust: bool = False) -> None:
        found = read_policy(SHIPPED if path is None else Path(path).expanduser(), "giver", trust)
        self._label = self.name if path is None else f"{self.name}:{found.label}"
        self._policy = LearnedPolicy(found.spec, found.function)

    @property
    def label(self) -> str:
        """The name, and for a file of one's own which one."""
        return self._label

    @property
    def hold_time(self) -> float:
        """As the policy was trained (s)."""
        return self._policy.spec.control_period

    def reset(self, seed: int | None = None) -> None:
        """Forget the last handover."""
        self._policy.reset()

    def act(self, observation: Observation) -> Action:
        """Ask the policy."""
        return self._policy.act(observation)
