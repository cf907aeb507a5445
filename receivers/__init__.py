"""Receivers: policies of the robot.

`hold` and `random` are simple baselines, `yang2021` is the reactive baseline of HandoverSim, and
`omg`, `omg_hand_aware` and `omg_unchecked_last` plan motions. `reactive` follows the true poses of
object and hand; `vision` and `gaddpg` use point clouds of the wrist camera. `learned:FILE` is a
trained policy. A new receiver is a subclass of `Receiver`; packages register theirs by name in the
entry-point group `handover_marl.receivers`.
"""

from typing import cast

from handover_marl.datasets import Dataset
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.policies import registry
from handover_marl.policies.policy import Action, PolicyContext, Receiver, make_policy_context
from handover_marl.policies.reference import PolicyLike, parse_policy

__all__ = ["WAITING_JOINTS", "Action", "PolicyContext", "Receiver", "list_available", "make", "make_policy_context"]


def list_available() -> tuple[str, ...]:
    """Return the names of the available receivers."""
    return registry.list_available("receiver")


def make(receiver: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str = "s0") -> Receiver:
    """Create a receiver for the robot and objects of a dataset.

    Args:
        receiver: Registered name, with options or a file, or a class; see
            `handover_marl.policies.reference`.
        dataset: Dataset with the robot and objects; default: the one `open_dataset()` returns.
        trust: Whether code in a policy file may be executed.
        setup: Official setup, s0 to s3, whose weights a learned receiver uses.

    Raises:
        UnknownNameError: No receiver of this name is registered.
        HandoverError: The receiver cannot be created, or its policy file cannot be loaded.
    """
    return cast(Receiver, parse_policy("receiver", receiver, trust).make(dataset, setup=setup))
