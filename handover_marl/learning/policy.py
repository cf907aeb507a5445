"""A learned policy: features of an observation, a function of them, and what its outputs mean as an action."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.learning.observing import make_features, n_features
from handover_marl.learning.schemes import make_scheme, scheme_size
from handover_marl.observations import Observation
from handover_marl.receivers.base import ReceiverContext


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


class LearnedPolicy:
    """Acts as a function says.

    Args:
        spec: How it is used.
        function: From features to outputs.
        context: The robot and the objects' grasps; only receivers have one.

    Raises:
        UnknownNameError: There are no such features or actions.
        DataFormatError: The function takes or gives another number of values.
    """

    def __init__(self, spec: PolicySpec, function: Function, context: ReceiverContext | None = None) -> None:
        wanted = (n_features(spec.agent, spec.features), scheme_size(spec.agent, spec.actions))
        if (function.n_inputs, function.n_outputs) != wanted:
            raise DataFormatError(
                f"the policy takes {function.n_inputs} numbers and gives {function.n_outputs}; features "
                f"{spec.features!r} are {wanted[0]} and actions {spec.actions!r} are {wanted[1]}"
            )
        self.spec = spec
        self._features = make_features(spec.agent, spec.features, context)
        self._scheme = make_scheme(spec.agent, spec.actions, context)
        self._function = function

    def reset(self) -> None:
        """Forget the last episode."""
        self._scheme.reset()

    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        """The agent's action."""
        if self._scheme.asks(observation):
            self._scheme.decide(self._function(self._features(observation)))
        return self._scheme.action(observation)
