"""Givers and receivers as a network learned them."""

import os
from pathlib import Path

import handover_marl.givers
from handover_marl.episode.observations import Observation
from handover_marl.errors import DataFormatError, OptionError
from handover_marl.learning.observing import make_features, n_features
from handover_marl.learning.policy_files import PolicyFile, read_policy
from handover_marl.learning.schemes import make_scheme, scheme_size
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action, Policy
from handover_marl.policies.waiting import wait_ms

#: Trained for the receiver yang2021; the file says how.
SHIPPED_GIVER = Path(handover_marl.givers.__file__).parent / "policies" / "for_yang2021.npz"


class LearnedPolicy(Policy):
    """Does what a trained policy says: `learned:FILE`; without a file, the giver in the box.

    Args:
        agent: Whose policy it is, "giver" or "receiver".
        context: The robot, the task and the objects' grasps.
        path: A policy file, see `handover_marl.learning.policy_files`.
        trust: Whether code in the file may run.
        control_period: How often it was asked in training (s), for files that do not tell.
        wait: How long to stay at the waiting pose (s) instead of as in training, for schemes with a wait.

    Raises:
        DataNotFoundError, DataFormatError, UnsafeFileError, OptionError: As `read_policy`; OptionError also without
            a file for a receiver, of which none is shipped.
    """

    name = "learned"

    def __init__(
        self,
        agent: str,
        context: PolicyContext,
        path: str | os.PathLike[str] | None = None,
        trust: bool = False,
        control_period: float | None = None,
        wait: float | None = None,
    ) -> None:
        if path is None and agent != "giver":
            raise OptionError(f"{agent} 'learned' needs a policy file: learned:FILE, see experiments/")
        file = SHIPPED_GIVER if path is None else Path(path).expanduser()
        found = read_policy(file, agent, trust, control_period)
        self._label = self.name if path is None else f"{self.name}:{found.label}"
        self._use(found, context)
        if wait is not None:
            if not self._scheme.wait:
                raise OptionError(f"{found.label}: its actions ({found.spec.actions!r}) have no wait to be set")
            self._scheme.wait = wait_ms(wait) / 1000.0

    def _use(self, found: PolicyFile, context: PolicyContext) -> None:
        spec, function = found.spec, found.function
        wanted = (n_features(spec.agent, spec.features), scheme_size(spec.agent, spec.actions))
        if (function.n_inputs, function.n_outputs) != wanted:
            raise DataFormatError(
                f"{found.label}: the policy takes {function.n_inputs} numbers and gives {function.n_outputs}; "
                f"features {spec.features!r} are {wanted[0]} and actions {spec.actions!r} are {wanted[1]}"
            )
        self.spec = spec
        self._function = function
        self._features = make_features(spec.agent, spec.features, context)
        self._scheme = make_scheme(spec.agent, spec.actions, context)

    @property
    def label(self) -> str:
        """The name, and which file."""
        return self._label

    @property
    def wait(self) -> float:
        """How long it stays at the waiting pose (s)."""
        return self._scheme.wait

    @property
    def hold_time(self) -> float:
        """As the policy was trained (s)."""
        return self.spec.control_period

    def reset(self, seed: int | None = None) -> None:
        """Forget the last episode; nothing here is random."""
        self._scheme.reset()

    def act(self, observation: Observation) -> Action:
        """Ask the policy, if its scheme wants outputs now."""
        if self._scheme.asks(observation):
            self._scheme.decide(self._function(self._features(observation)))
        return self._scheme.action(observation)
