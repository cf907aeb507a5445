"""How a function is used as a policy."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt


class Function(Protocol):
    """What turns features into outputs, such as a `Network`."""

    @property
    def n_inputs(self) -> int:
        """Numbers that go in."""

    @property
    def n_outputs(self) -> int:
        """Numbers that come out."""

    def __call__(self, inputs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(n_outputs,) for (n_inputs,)."""


@dataclass(frozen=True)
class PolicySpec:
    """How a function is to be used as a policy.

    Attributes:
        agent: "giver" or "receiver".
        features: What it sees, a name in `handover_marl.learning.observing`.
        actions: What its outputs mean, a name in `handover_marl.learning.schemes`.
        control_period: How often it is asked (s).
        origin: How it was made: command, seed, budget; for people.
    """

    agent: str
    features: str
    actions: str
    control_period: float = 0.1
    origin: str = ""
