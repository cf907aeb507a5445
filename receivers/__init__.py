"""Receivers: policies of the robot.

`hold` and `random` are simple baselines, `yang2021` is a baseline of HandoverSim, and `omg`, `omg_hand_aware` and
`omg_unchecked_last` plan motions. `reactive` follows the true poses of object and hand; `vision` and `gaddpg` use point
clouds of the wrist camera. `dagger` and `learned:FILE` are trained networks. In each episode, `population` acts as a
receiver that is drawn from a set of receivers. A new receiver is a subclass of `Receiver`; packages register receivers
by name in the entry-point group `handover_marl.receivers`.
"""

from handover_marl.datasets import Dataset
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.policies import registry
from handover_marl.policies.policy import Action, Policy, PolicyContext, Receiver, make_policy_context
from handover_marl.policies.reference import PolicyLike, parse_policy

__all__ = ["WAITING_JOINTS", "Action", "PolicyContext", "Receiver", "list_available", "make", "make_policy_context"]


def list_available() -> tuple[str, ...]:
    """Return the names of the registered receivers."""
    return registry.list_available("receiver")


def make(policy: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str | None = None) -> Policy:
    """Create a receiver from text such as "vision:wait=1" or from a class, for the robot and objects of a dataset.

    The default dataset is `open_dataset()`. With `trust`, modules that only a policy file names may be imported. Some
    receivers ship with weights for each setup; `setup` selects these, and the default is the dataset's first setup.

    Raises:
        UnknownNameError, OptionError: There is no such receiver or option, or an option has a wrong value.
        HandoverError: The receiver cannot be created, or the default dataset cannot be opened.
    """
    return parse_policy("receiver", policy, trust).make(dataset, setup=setup)
