"""Robots as a network learned them."""

import os
from pathlib import Path

from handover_marl.errors import OptionError
from handover_marl.learning.policy import LearnedPolicy
from handover_marl.learning.policy_files import read_policy
from handover_marl.observations import Observation
from handover_marl.receivers.base import Action, Receiver, ReceiverContext


class LearnedReceiver(Receiver):
    """Does what a trained policy says: `learned:FILE`.

    Args:
        context: The robot.
        path: A policy file, see `handover_marl.learning.policy_files`.
        trust: Whether code in the file may run.

    Raises:
        DataNotFoundError, DataFormatError, UnsafeFileError, OptionError: As `read_policy`.
    """

    name = "learned"

    def __init__(
        self, context: ReceiverContext, path: str | os.PathLike[str] | None = None, trust: bool = False
    ) -> None:
        super().__init__(context)
        if path is None:
            raise OptionError("receiver 'learned' needs a policy file: learned:FILE, see experiments/")
        found = read_policy(Path(path).expanduser(), "receiver", trust)
        self._label = f"{self.name}:{found.label}"
        self._policy = LearnedPolicy(found.spec, found.function, context)

    @property
    def label(self) -> str:
        """The name and which file."""
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
