"""What an action scheme is: the meaning of a network's outputs, all within -1 and 1, as actions.

Networks learn best with few outputs of one size, and zero for a sensible thing to do. The learning environments
and the learned policies use the same schemes, so that outputs mean the same in both.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.policies.context import PolicyContext

Outputs = npt.NDArray[np.floating]
Action = npt.NDArray[np.float32]


class ActionScheme(ABC):
    """Turns outputs into an agent's actions.

    Attributes:
        name: What policy files call it.
        agent: Whose actions these are, "giver" or "receiver".
        size: Number of outputs.
        wait: How long the agent stays away at the start of an episode (s); may be set where it is not zero.

    Args:
        context: The robot, the task and the objects' grasps.
    """

    name: ClassVar[str]
    agent: ClassVar[str]
    size: ClassVar[int]
    wait: float = 0.0

    def __init__(self, context: PolicyContext) -> None:
        self.context = context

    def reset(self) -> None:
        """Forget the last episode."""
        self._outputs = np.zeros(self.size)

    def asks(self, observation: Observation) -> bool:
        """Whether outputs are wanted now; in between, the last ones stand."""
        return True

    def decide(self, outputs: Outputs) -> None:
        """Take new outputs, (size,) clipped to -1 and 1."""
        self._outputs = np.clip(np.asarray(outputs, dtype=np.float64), -1.0, 1.0)

    @abstractmethod
    def action(self, observation: Observation) -> Action:
        """The agent's action, an element of its space."""


class Raw(ActionScheme):
    """Outputs are the action itself, as they are."""

    def decide(self, outputs: Outputs) -> None:
        """Take new outputs, not clipped."""
        self._outputs = np.asarray(outputs, dtype=np.float64)

    def action(self, observation: Observation) -> Action:
        """The outputs."""
        return self._outputs.astype(np.float32)
