"""Action schemes by name."""

from collections.abc import Callable
from pathlib import Path

from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.kinematic_tree import read_tree
from handover_marl.learning.giver_schemes import Deviation, GiverRaw, Offer
from handover_marl.learning.receiver_schemes import CartesianDelta, JointDelta, Joints, ReceiverRaw
from handover_marl.learning.scheme import ActionScheme
from handover_marl.receivers.base import ReceiverContext

_SCHEMES: dict[str, type[ActionScheme]] = {
    kind.name: kind for kind in (GiverRaw, Deviation, Offer, ReceiverRaw, Joints, JointDelta, CartesianDelta)
}
_WITH_KINEMATICS: dict[str, Callable[[Path], ActionScheme]] = {
    CartesianDelta.name: lambda urdf: CartesianDelta(read_tree(urdf))
}


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
    scheme = _SCHEMES[name]() if name not in _WITH_KINEMATICS else _with_kinematics(name, context)
    scheme.reset()
    return scheme


def _with_kinematics(name: str, context: ReceiverContext | None) -> ActionScheme:
    if context is None:
        raise OptionError(f"action scheme {name!r} needs the robot's model")
    return _WITH_KINEMATICS[name](context.panda_urdf)
