"""Base class of action schemes, which convert network outputs in [-1, 1] to an agent's actions.

Networks learn best with few outputs of equal scale for which zero is a sensible action. The
learning environments and the learned policies decode outputs with the same schemes.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import PolicyContext

Outputs = npt.NDArray[np.floating]
Action = npt.NDArray[np.float32]


class ActionScheme(ABC):
    """Decoder of network outputs into the actions of one agent.

    Attributes:
        name: Name of the scheme in policy files.
        agent: Agent that acts, "giver" or "receiver".
        size: Number of outputs.
        wait: Time at the start of an episode during which the agent does not act (s); may be changed
            only in schemes in which it is not zero by default.
        outputs: Current outputs (size,) of the network, float64; zeros at the start of an episode.

    Args:
        context: Robot, task and known grasps of the objects.
    """

    name: ClassVar[str]
    agent: ClassVar[str]
    size: ClassVar[int]
    wait: float = 0.0

    def __init__(self, context: PolicyContext) -> None:
        self.context = context
        self.reset()

    def reset(self) -> None:
        """Clear the state of the previous episode."""
        self.outputs: npt.NDArray[np.float64] = np.zeros(self.size)

    def needs_outputs(self, observation: Observation) -> bool:
        """Return whether the network must be evaluated now; else its previous outputs remain in use."""
        return True

    def set_outputs(self, outputs: Outputs) -> None:
        """Store new network outputs (size,), clipped to [-1, 1]."""
        self.outputs = np.clip(np.asarray(outputs, dtype=np.float64), -1.0, 1.0)

    @abstractmethod
    def compute_action(self, observation: Observation) -> Action:
        """Return the agent's action for the current outputs, an element of its action space."""
