"""Base class of policies that evaluate a function on encoded observations."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError
from handover_marl.learning.action_scheme import ActionScheme, Outputs
from handover_marl.learning.encodings.custom_features import FeaturesLike
from handover_marl.policies.policy import Action, Policy, milliseconds_from_wait


class NetworkPolicy(Policy):
    """Policy that encodes observations, evaluates a function, and decodes its outputs.

    Args:
        encode: Function from observations to inputs.
        scheme: Action scheme that decodes outputs.
        control_period: Time between two decisions (s).
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: as in training. Only action schemes that wait have this option.
        where: Name of the policy in error messages.

    Raises:
        OptionError: `wait` is given and the action scheme does not wait.
    """

    def __init__(
        self,
        encode: Callable[[Observation], Any],
        scheme: ActionScheme,
        control_period: float,
        wait: float | None,
        where: str,
    ) -> None:
        self._encode, self._scheme, self._control_period = encode, scheme, control_period
        if wait is not None:
            if not scheme.wait:
                raise OptionError(f"{where}: action scheme {scheme.name!r} has no wait; remove wait={wait}")
            scheme.wait = milliseconds_from_wait(wait) / 1000.0

    @property
    def scheme(self) -> ActionScheme:
        """Action scheme that decodes the outputs."""
        return self._scheme

    @property
    @abstractmethod
    def features(self) -> FeaturesLike:
        """Features that the function receives: a name, a class or a function."""

    @property
    @abstractmethod
    def function(self) -> Callable[[Any], Any]:
        """Function from inputs to outputs."""

    @property
    def wait(self) -> float:
        """Time for which the robot stays at its waiting pose at the start of an episode (s)."""
        return self._scheme.wait

    @property
    def hold_time(self) -> float:
        """Time between two decisions (s), as in training."""
        return self._control_period

    def reset(self, seed: int | None = None) -> None:
        """Clear the state of the previous episode."""
        self._scheme.reset()
        reset = getattr(self._encode, "reset", None)
        if callable(reset):
            reset()

    @abstractmethod
    def evaluate(self, inputs: Any) -> Outputs:
        """Return the outputs (n_outputs,) of the function for encoded inputs."""

    def act(self, observation: Observation) -> Action:
        """Return the next action; evaluate the function only if the action scheme requires it."""
        if self._scheme.needs_outputs(observation):
            self._scheme.set_outputs(self.evaluate(self._encode(observation)))
        return self._scheme.compute_action(observation)
