"""Policies for the receiver, the robot side.

`hold` stays at the start pose, `random` does anything; `yang2021` is the reactive baseline of HandoverSim; `omg`,
`omg_hand_aware` and `omg_unchecked_last` plan; `learned:FILE` is a trained policy. Your own is a subclass of
`Receiver`; packages add theirs by name through the entry-point group `handover_marl.receivers`.
"""

from typing import cast

from handover_marl.datasets import Dataset
from handover_marl.models.panda import WAITING_JOINTS
from handover_marl.policies import registry
from handover_marl.policies.context import PolicyContext, context_of
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.reference import PolicyLike, policy_reference

__all__ = ["WAITING_JOINTS", "Action", "PolicyContext", "Receiver", "available", "context_of", "make"]


def available() -> tuple[str, ...]:
    """Names of the receivers that can be made."""
    return registry.available("receiver")


def make(receiver: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str = "s0") -> Receiver:
    """A receiver for the robot and objects of a dataset.

    Args:
        receiver: A registered name, with options or a file, a class; see `handover_marl.policies.reference`.
        dataset: Whose robot and objects; default: what `open_dataset()` gives.
        trust: Whether code in a policy file may run.
        setup: The official setup that it is to play, for which it may have been trained.

    Raises:
        UnknownNameError: No receiver of this name is registered.
        HandoverError: It cannot be made, or its file is no policy that may be loaded.
    """
    return cast(Receiver, policy_reference("receiver", receiver, trust).make(dataset, setup=setup))
