"""Policies of the giver, the human side.

`replay` replays the recorded human; `hesitant`, `hurried`, `noisy`, `displaced`, `recording_spread`, `tired` and
`interrupting` vary the recording. `stop_when_near`, `cooperative`, `withdrawing` and `early_release` react to the
robot. `population` acts as a randomly drawn giver of a population in each episode. `learned` is a trained policy,
`learned:FILE` loads another one.
User-defined givers are subclasses of `Giver`; packages register them by name in the entry-point group
`handover_marl.givers`.
"""

from handover_marl.policies.factory import PolicyFactory
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action, make_policy_context

__all__ = [
    "Action",
    "Giver",
    "PolicyContext",
    "list_available",
    "make",
    "make_giver_action",
    "make_policy_context",
]

_factory = PolicyFactory[Giver]("giver")
list_available, make = _factory.list_available, _factory.make
