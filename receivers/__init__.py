"""Receivers: policies of the robot.

`hold` and `random` are simple baselines, `yang2021` is the reactive baseline of HandoverSim, and
`omg`, `omg_hand_aware` and `omg_unchecked_last` plan motions. `reactive` follows the true poses of
object and hand; `vision` and `gaddpg` use point clouds of the wrist camera. `learned:FILE` is a
trained policy. A new receiver is a subclass of `Receiver`; packages register theirs by name in the
entry-point group `handover_marl.receivers`.
"""

from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.policies.factory import PolicyFactory
from handover_marl.policies.policy import Action, PolicyContext, Receiver, make_policy_context

__all__ = ["WAITING_JOINTS", "Action", "PolicyContext", "Receiver", "list_available", "make", "make_policy_context"]

_factory = PolicyFactory[Receiver]("receiver")
list_available, make = _factory.list_available, _factory.make
