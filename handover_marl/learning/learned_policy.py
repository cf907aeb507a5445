"""Givers and receivers that run a trained network."""

import os
from pathlib import Path

import handover_marl.givers
from handover_marl.errors import DataFormatError, OptionError
from handover_marl.learning.action_scheme import Outputs
from handover_marl.learning.adapters.network_policy import NetworkPolicy
from handover_marl.learning.encodings.custom_features import Vector
from handover_marl.learning.features import make_features
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.policy_spec import PolicyFunction
from handover_marl.learning.schemes import make_scheme
from handover_marl.policies.policy import PolicyContext

#: Shipped giver, trained for the receiver `yang2021`.
DEFAULT_GIVER_FILE = Path(handover_marl.givers.__file__).parent / "policies" / "for_yang2021.npz"


class LearnedPolicy(NetworkPolicy):
    """Policy that runs a trained network, `learned:FILE`; the giver `learned` runs the shipped file.

    Args:
        agent: Agent that the policy controls, "giver" or "receiver".
        context: Robot, task and known grasps of the objects.
        path: Policy file, see `handover_marl.learning.policy_files`.
        trust: Whether code in the file may run.
        control_period: Time between two decisions in training (s), for files that do not record it.
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: as in training. Only action schemes that wait have this option.

    Raises:
        DataNotFoundError: The file does not exist.
        DataFormatError: The file is damaged or for another agent.
        UnsafeFileError: The file contains code, or names user-defined features or schemes (`module:name`),
            and is not trusted.
        OptionError: A receiver has no file, or an option does not fit the file.
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
        file = DEFAULT_GIVER_FILE if path is None else Path(path).expanduser()
        found = read_policy(file, agent, trust, control_period)
        self._label = self.name if path is None else f"{self.name}:{found.label}"
        self.spec, self._function = found.spec, found.function
        features = make_features(agent, self.spec.features, context)
        scheme = make_scheme(agent, self.spec.actions, context)
        sizes = features.size, scheme.size
        if (self._function.n_inputs, self._function.n_outputs) != sizes:
            raise DataFormatError(
                f"{found.label}: the network must have {sizes[0]} inputs for features {self.spec.features!r} and "
                f"{sizes[1]} outputs for actions {self.spec.actions!r}, got {self._function.n_inputs} and "
                f"{self._function.n_outputs}"
            )
        super().__init__(features, scheme, self.spec.control_period, wait, found.label)

    @property
    def features(self) -> str:
        """Name of the features that the network receives."""
        return self.spec.features

    @property
    def function(self) -> PolicyFunction:
        """Function from features to outputs."""
        return self._function

    @property
    def label(self) -> str:
        """Unique label of the policy in result files: its name, file name and file hash."""
        return self._label

    def evaluate(self, inputs: Vector) -> Outputs:
        """Return the outputs (n_outputs,) of the network for features (n_inputs,)."""
        return self._function(inputs)
