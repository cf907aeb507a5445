"""Action schemes by name."""

from handover_marl.errors import UnknownNameError
from handover_marl.learning.giver_schemes import Deviation, GiverRaw, Offer
from handover_marl.learning.receiver_schemes import (
    CartesianDelta,
    GraspServo,
    JointDelta,
    Joints,
    ReceiverRaw,
)
from handover_marl.learning.scheme import ActionScheme
from handover_marl.policies.context import PolicyContext

_KINDS: tuple[type[ActionScheme], ...] = (
    *(GiverRaw, Deviation, Offer),
    *(ReceiverRaw, Joints, JointDelta, CartesianDelta, GraspServo),
)
_SCHEMES = {kind.name: kind for kind in _KINDS}


def schemes(agent: str) -> tuple[str, ...]:
    """Names of an agent's action schemes."""
    return tuple(name for name, kind in _SCHEMES.items() if kind.agent == agent)


def scheme_size(agent: str, name: str) -> int:
    """Number of outputs of a scheme.

    Raises:
        UnknownNameError: The agent has none of that name.
    """
    if name not in schemes(agent):
        raise UnknownNameError(f"action scheme of the {agent}", name, schemes(agent))
    return _SCHEMES[name].size


def make_scheme(agent: str, name: str, context: PolicyContext) -> ActionScheme:
    """An agent's action scheme by name.

    Args:
        agent: "giver" or "receiver".
        name: Name of the scheme.
        context: The robot, the task and the objects' grasps.

    Raises:
        UnknownNameError: The agent has none of that name.
    """
    scheme_size(agent, name)
    scheme = _SCHEMES[name](context)
    scheme.reset()
    return scheme
