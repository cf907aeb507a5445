"""Givers and receivers that run the network of a policy file."""

import os
from pathlib import Path

import handover_marl.givers
from handover_marl.errors import OptionError
from handover_marl.learning.adapters.function_policy import Encoding, FunctionPolicy
from handover_marl.learning.policy_files import read_policy
from handover_marl.policies.policy import PolicyContext

#: Shipped giver, trained for the receiver `yang2021`.
DEFAULT_GIVER_FILE = Path(handover_marl.givers.__file__).parent / "policies" / "for_yang2021.npz"


class LearnedPolicy(FunctionPolicy):
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
        found = read_policy(
            DEFAULT_GIVER_FILE if path is None else Path(path).expanduser(), agent, trust, control_period
        )
        encoding = Encoding(found.spec.features, found.spec.actions, found.spec.control_period)
        # Its name and the name and hash of the file.
        label = self.name if path is None else f"{self.name}:{found.label}"
        super().__init__(agent, context, found.function, encoding, self.name, label, wait=wait)
