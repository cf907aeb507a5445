"""Policies for the receiver, the robot side, by name.

`hold` stays at the start pose, `random` does anything; `yang2021` is the reactive baseline of HandoverSim;
`learned:FILE` is a trained policy. Packages add their own through
the entry-point group `handover_marl.receivers`.
"""

from typing import cast

from handover_marl import registry
from handover_marl.datasets import Dataset
from handover_marl.receivers.base import WAITING_JOINTS, Action, Receiver, ReceiverContext

GROUP = "handover_marl.receivers"

__all__ = ["WAITING_JOINTS", "Action", "Receiver", "ReceiverContext", "available", "context_of", "make"]


def available() -> tuple[str, ...]:
    """Names of the receivers that can be made."""
    return registry.available(GROUP)


def context_of(dataset: Dataset) -> ReceiverContext:
    """What receivers may know of a dataset."""
    return ReceiverContext(dataset.panda_urdf, dataset.grasps, dataset.object_urdf)


def make(name: str, dataset: Dataset, trust: bool = False) -> Receiver:
    """A receiver by name, for the robot and objects of a dataset.

    Args:
        name: A registered name, or `learned:FILE` for a policy file.
        dataset: Whose robot and objects.
        trust: Whether code in such a file may run.

    Raises:
        UnknownNameError: No receiver of this name is registered.
        HandoverError: The file is not there, or is no policy that may be loaded.
    """
    kind, file = registry.load(GROUP, name, Receiver)
    context = context_of(dataset)
    return cast(Receiver, kind(context) if file is None else kind(context, path=file, trust=trust))
