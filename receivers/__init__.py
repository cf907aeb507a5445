"""Policies for the receiver, the robot side, by name.

`hold` stays at the start pose; `yang2021` is the reactive baseline of HandoverSim. Packages add their own through
the entry-point group `handover_marl.receivers`.
"""

from typing import cast

from handover_marl import registry
from handover_marl.datasets import Dataset
from handover_marl.receivers.base import WAITING_JOINTS, Action, Receiver, ReceiverContext

GROUP = "handover_marl.receivers"

__all__ = ["WAITING_JOINTS", "Action", "Receiver", "ReceiverContext", "available", "make"]


def available() -> tuple[str, ...]:
    """Names of the receivers that can be made."""
    return registry.available(GROUP)


def make(name: str, dataset: Dataset) -> Receiver:
    """A receiver by name, for the robot and objects of a dataset.

    Raises:
        UnknownNameError: No receiver of this name is registered.
    """
    kind = cast(type[Receiver], registry.load(GROUP, name, Receiver))
    return kind(ReceiverContext(panda_urdf=dataset.panda_urdf, grasps=dataset.grasps))
