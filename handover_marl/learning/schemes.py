"""Registry of the action schemes by agent and name."""

from handover_marl.errors import check_name
from handover_marl.learning.action_scheme import ActionScheme
from handover_marl.learning.giver_schemes import DeviationScheme, HandoverPoseScheme, RawGiverScheme
from handover_marl.learning.receiver_schemes import (
    CartesianDeltaScheme,
    GraspServoScheme,
    JointDeltaScheme,
    JointPositionScheme,
    RawReceiverScheme,
)
from handover_marl.policies.policy import PolicyContext

_ALL: tuple[type[ActionScheme], ...] = (
    *(RawGiverScheme, DeviationScheme, HandoverPoseScheme),
    *(RawReceiverScheme, JointPositionScheme, JointDeltaScheme, CartesianDeltaScheme, GraspServoScheme),
)
_SCHEMES = {scheme.name: scheme for scheme in _ALL}


def available_schemes(agent: str) -> tuple[str, ...]:
    """Return the names of an agent's action schemes."""
    return tuple(name for name, scheme in _SCHEMES.items() if scheme.agent == agent)


def scheme_size(agent: str, name: str) -> int:
    """Return the number of network outputs that an agent's action scheme decodes.

    Raises:
        UnknownNameError: The agent has no scheme of that name.
    """
    check_name(f"action scheme of the {agent}", name, available_schemes(agent))
    return _SCHEMES[name].size


def make_scheme(agent: str, name: str, context: PolicyContext) -> ActionScheme:
    """Create an agent's action scheme by name.

    Args:
        agent: "giver" or "receiver".
        name: One of `available_schemes(agent)`.
        context: Robot, task and known grasps of the objects.

    Raises:
        UnknownNameError: The agent has no scheme of that name.
    """
    scheme_size(agent, name)
    return _SCHEMES[name](context)
