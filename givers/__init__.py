"""Policies of the giver, the human side.

`replay` replays the recorded human; `hesitant`, `hurried` and `noisy` vary the recording.
`stop_when_near`, `cooperative` and `withdrawing` react to the robot. `learned` is a trained policy,
`learned:FILE` loads another policy.
Own givers are subclasses of `Giver`; packages register them by name in the entry-point group
`handover_marl.givers`.
"""

from typing import cast

from handover_marl.datasets import Dataset
from handover_marl.policies import registry
from handover_marl.policies.policy import Action, Giver, make_giver_action
from handover_marl.policies.reference import PolicyLike, parse_policy

__all__ = ["Action", "Giver", "list_available", "make", "make_giver_action"]


def list_available() -> tuple[str, ...]:
    """Return the names of the registered givers."""
    return registry.list_available("giver")


def make(giver: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str = "s0") -> Giver:
    """Create a giver for the scenes of a dataset.

    Args:
        giver: Registered name, with options or a file, or a class; see
            `handover_marl.policies.reference`.
        dataset: Dataset with the robot and objects; default: the one `open_dataset()` returns.
        trust: Whether code in a policy file may be executed.
        setup: Official setup, s0 to s3, whose weights a learned giver uses.

    Raises:
        UnknownNameError: No giver of this name is registered.
        HandoverError: The giver cannot be created, or its policy file cannot be loaded.
    """
    return cast(Giver, parse_policy("giver", giver, trust).make(dataset, setup=setup))
