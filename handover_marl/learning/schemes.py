"""Action schemes by name."""

from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.learning.giver_schemes import Deviation, GiverRaw, Offer
from handover_marl.learning.receiver_schemes import (
    CartesianDelta,
    GraspServo,
    JointDelta,
    Joints,
    ReceiverRaw,
)
from handover_marl.learning.scheme import ActionScheme
from handover_marl.receivers.base import ReceiverContext

_PLAIN: tuple[type[ActionScheme], ...] = (GiverRaw, Deviation, Offer, ReceiverRaw, Joints, JointDelta)
_CARTESIAN: dict[str, type[CartesianDelta]] = {kind.name: kind for kind in (CartesianDelta, GraspServo)}
_SCHEMES: dict[str, type[ActionScheme]] = {kind.name: kind for kind in _PLAIN} | _CARTESIAN


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


def make_scheme(agent: str, name: str, context: ReceiverContext | None = None) -> ActionScheme:
    """An agent's action scheme by name.

    Args:
        agent: "giver" or "receiver".
        name: Name of the scheme.
        context: The robot, which Cartesian schemes need to know.

    Raises:
        UnknownNameError: The agent has none of that name.
        OptionError: The scheme needs the robot's model.
    """
    scheme_size(agent, name)
    scheme = _cartesian(name, context) if name in _CARTESIAN else _SCHEMES[name]()
    scheme.reset()
    return scheme


def _cartesian(name: str, context: ReceiverContext | None) -> ActionScheme:
    if context is None:
        raise OptionError(f"action scheme {name!r} needs the robot's model")
    return _CARTESIAN[name](context)
