"""Registry of the action schemes by agent and name."""

from typing import Any

from handover_marl.errors import check_name
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory
from handover_marl.learning.action_scheme import ArrayScheme, SingleScheme
from handover_marl.learning.custom_encodings import SCHEME, CustomScheme, SchemeLike, is_reference
from handover_marl.learning.giver_schemes import DeviationScheme, HandoverPoseScheme, RawGiverScheme
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.learning.receiver_schemes import (
    CartesianDeltaScheme,
    GraspServoScheme,
    JointDeltaScheme,
    JointPositionScheme,
    RawReceiverScheme,
)
from handover_marl.policies.policy import PolicyContext
from handover_marl.policies.registry import import_reference

_ALL: tuple[type[ArrayScheme], ...] = (
    *(RawGiverScheme, DeviationScheme, HandoverPoseScheme),
    *(RawReceiverScheme, JointPositionScheme, JointDeltaScheme, CartesianDeltaScheme, GraspServoScheme),
)
_SCHEMES = {scheme.name: scheme for scheme in _ALL}


def list_schemes(agent: str) -> tuple[str, ...]:
    """Return the names of the built-in action schemes of an agent, "giver" or "receiver"."""
    return tuple(name for name, scheme in _SCHEMES.items() if scheme.agent == agent)


def count_outputs(agent: str, name: str) -> int:
    """Return the number of outputs that a built-in action scheme, one of `list_schemes(agent)`, decodes.

    The number of outputs of a user-defined scheme is `make_scheme(...).size`.
    """
    check_name(f"{SCHEME} of the {agent}", name, list_schemes(agent))
    return _SCHEMES[name].size


def make_scheme(agent: str, choice: SchemeLike, context: PolicyContext) -> SingleScheme:
    """Make an agent's action scheme.

    Args:
        agent: "giver" or "receiver".
        choice: One of `list_schemes(agent)`; subclass of `ActionScheme`; function from outputs
            (size,) and an observation to an action, with a declared size (`declare_size`); or text
            `module:name` of a class or function.
        context: Robot, task and known grasps of the objects.
    """
    return SingleScheme(make_array_scheme(agent, choice, context, LowestCostGraspSelector(context, 1), 1), context)


def make_array_scheme(
    agent: str,
    choice: SchemeLike,
    context: PolicyContext,
    selector: LowestCostGraspSelector,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> ArrayScheme:
    """Make an agent's action scheme for n = `count` episodes; the first three arguments are those of `make_scheme`.

    Built-in schemes work on arrays that `arrays` creates, others episode by episode. Some approach the grasps that
    `selector` selects.
    """
    if isinstance(choice, str) and not is_reference(choice):
        count_outputs(agent, choice)
        return _SCHEMES[choice](context, selector, count, arrays)
    own: Any = import_reference(SCHEME, choice) if isinstance(choice, str) else choice
    return CustomScheme(agent, own, context, count, arrays, choice if isinstance(choice, str) else "")
