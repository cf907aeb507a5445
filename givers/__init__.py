"""Policies of the giver, the human side.

`replay` repeats the recorded motion; `hesitant`, `hurried`, `noisy`, `displaced`, `recording_spread`, `tired` and
`interrupting` vary the recording. `adaptive`, `stop_when_near`, `cooperative`, `withdrawing` and `early_release` react
to the robot. In each episode, `population` acts as a giver that is drawn from a set of givers, such as `strangers-v1`.
`learned:FILE` acts by the network of a policy file. User-defined givers are subclasses of `Giver`; packages register
them by name in the entry-point group `handover_marl.givers`.
"""

from handover_marl.datasets import Dataset
from handover_marl.policies import registry
from handover_marl.policies.policy import Action, Giver, Policy, PolicyContext, make_giver_action, make_policy_context
from handover_marl.policies.reference import PolicyLike, parse_policy

__all__ = ["Action", "Giver", "PolicyContext", "list_available", "make", "make_giver_action", "make_policy_context"]


def list_available() -> tuple[str, ...]:
    """Return the names of the registered givers."""
    return registry.list_available("giver")


def make(policy: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str | None = None) -> Policy:
    """Create a giver for the robot and objects of a dataset.

    Args:
        policy: Registered name, such as "hurried:max_rate=0.8", or class; see `handover_marl.policies.reference`.
        dataset: Dataset with the robot and objects; default: the one that `open_dataset()` returns.
        trust: Whether to import modules that only a policy file names.
        setup: Setup, for policies with different weights for each setup; default: the dataset's first setup.

    Raises:
        UnknownNameError: No giver of this name is registered.
        HandoverError: The giver cannot be created, for example because an option or its policy file is wrong.
    """
    return parse_policy("giver", policy, trust).make(dataset, setup=setup)
