"""Policies for the giver, the human side.

`replay` plays the recorded motion; `hesitant`, `hurried` and `noisy` vary it; `stop_when_near`, `cooperative` and
`withdrawing` react to the robot; `learned` was trained, `learned:FILE` by you. Your own is a subclass of `Giver`;
packages add theirs by name through the entry-point group `handover_marl.givers`.
"""

from typing import cast

from handover_marl.datasets import Dataset
from handover_marl.policies import registry
from handover_marl.policies.giver import Giver, deviation
from handover_marl.policies.policy import Action
from handover_marl.policies.reference import PolicyLike, policy_reference

__all__ = ["Action", "Giver", "available", "deviation", "make"]


def available() -> tuple[str, ...]:
    """Names of the givers that can be made."""
    return registry.available("giver")


def make(giver: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str = "s0") -> Giver:
    """A giver for the scenes of a dataset.

    Args:
        giver: A registered name, with options or a file, a class; see `handover_marl.policies.reference`.
        dataset: Whose robot and objects; default: what `open_dataset()` gives.
        trust: Whether code in a policy file may run.
        setup: The official setup that it is to play, for which it may have been trained.

    Raises:
        UnknownNameError: No giver of this name is registered.
        HandoverError: It cannot be made, or its file is no policy that may be loaded.
    """
    return cast(Giver, policy_reference("giver", giver, trust).make(dataset, setup=setup))
