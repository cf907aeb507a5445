"""Registry of the features and of the action schemes, by agent and name."""

from typing import Any

from handover_marl.errors import check_name
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.encodings.action_scheme import ArrayScheme, SingleEpisodeScheme
from handover_marl.learning.encodings.custom import (
    FEATURES,
    SCHEME,
    CustomFeatures,
    CustomScheme,
    FeaturesLike,
    SchemeLike,
    is_reference,
)
from handover_marl.learning.encodings.features import (
    ArrayFeatures,
    FlatGiverFeatures,
    FlatReceiverFeatures,
    GiverFeatures,
    GraspFeatures,
    GraspProximityFeatures,
    GraspVelocityFeatures,
    ReceiverFeatures,
    StackedFeatures,
)
from handover_marl.learning.encodings.schemes import (
    CartesianDeltaScheme,
    DeviationScheme,
    GraspServoScheme,
    HandoverPoseScheme,
    JointDeltaScheme,
    JointPositionScheme,
    RawGiverScheme,
    RawReceiverScheme,
)
from handover_marl.learning.policy_files import OBSERVATION
from handover_marl.policies.policy import PolicyContext
from handover_marl.policies.registry import import_reference

_ALL_FEATURES: tuple[type[ArrayFeatures], ...] = (
    GiverFeatures,
    FlatGiverFeatures,
    ReceiverFeatures,
    FlatReceiverFeatures,
    GraspFeatures,
    GraspVelocityFeatures,
    GraspProximityFeatures,
    StackedFeatures,
)
_ALL_SCHEMES: tuple[type[ArrayScheme], ...] = (
    RawGiverScheme,
    DeviationScheme,
    HandoverPoseScheme,
    RawReceiverScheme,
    JointPositionScheme,
    JointDeltaScheme,
    CartesianDeltaScheme,
    GraspServoScheme,
)
_FEATURES = {features.name: features for features in _ALL_FEATURES}
_SCHEMES = {scheme.name: scheme for scheme in _ALL_SCHEMES}


def list_features(agent: str) -> tuple[str, ...]:
    """Return the names of the built-in features of an agent, "giver" or "receiver"."""
    check_name("agent", agent, ("giver", "receiver"))
    return tuple(name for name, features in _FEATURES.items() if features.agent == agent)


def list_schemes(agent: str) -> tuple[str, ...]:
    """Return the names of the built-in action schemes of an agent, "giver" or "receiver"."""
    check_name("agent", agent, ("giver", "receiver"))
    return tuple(name for name, scheme in _SCHEMES.items() if scheme.agent == agent)


def count_features(agent: str, name: str) -> int:
    """Return the number of an agent's built-in features `name`, one of `list_features(agent)`."""
    check_name(f"{FEATURES} of the {agent}", name, list_features(agent))
    return _FEATURES[name].size


def count_outputs(agent: str, name: str) -> int:
    """Return the number of outputs that a built-in action scheme, one of `list_schemes(agent)`, decodes."""
    check_name(f"{SCHEME} of the {agent}", name, list_schemes(agent))
    return _SCHEMES[name].size


def check_encodings(agent: str, features: FeaturesLike, scheme: SchemeLike) -> None:
    """Raise UnknownNameError for a name that no built-in features, or no built-in scheme, of the agent have.

    Classes, functions, texts `module:name` and the features "observation" are not checked.
    """
    if isinstance(features, str) and not is_reference(features) and features != OBSERVATION:
        count_features(agent, features)
    if isinstance(scheme, str) and not is_reference(scheme):
        count_outputs(agent, scheme)


def make_array_features(
    agent: str,
    choice: FeaturesLike,
    context: PolicyContext,
    selector: LowestCostGraspSelector,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> ArrayFeatures:
    """Make an agent's features for n = `count` episodes; user-defined features are computed episode by episode.

    Args:
        agent: "giver" or "receiver".
        choice: Name of built-in features; subclass of `FeatureExtractor`; function with a declared size
            (`declare_size`); or text `module:name` of a class or function.
        context: Robot, task and known grasps of the objects.
        selector: Selector of the grasps that some built-in features contain.
        count: Number n of episodes.
        arrays: Factory of the arrays.
    """
    list_features(agent)
    if isinstance(choice, str) and not is_reference(choice):
        count_features(agent, choice)
        return _FEATURES[choice](context, selector, count, arrays)
    own: Any = import_reference(FEATURES, choice) if isinstance(choice, str) else choice
    return CustomFeatures(agent, own, context, count, arrays, choice if isinstance(choice, str) else "")


def make_array_scheme(
    agent: str,
    choice: SchemeLike,
    context: PolicyContext,
    selector: LowestCostGraspSelector,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> ArrayScheme:
    """Make an agent's action scheme for n = `count` episodes; arguments are those of `make_array_features`.

    `choice` is one of `list_schemes(agent)`; a subclass of `ActionScheme`; a function from outputs (size,) and an
    observation to an action, with a declared size (`declare_size`); or text `module:name` of a class or function.
    """
    if isinstance(choice, str) and not is_reference(choice):
        count_outputs(agent, choice)
        return _SCHEMES[choice](context, selector, count, arrays)
    own: Any = import_reference(SCHEME, choice) if isinstance(choice, str) else choice
    return CustomScheme(agent, own, context, count, arrays, choice if isinstance(choice, str) else "")


def make_action_scheme(agent: str, choice: SchemeLike, context: PolicyContext) -> SingleEpisodeScheme:
    """Make an agent's action scheme for a single episode; arguments are those of `make_array_scheme`."""
    return SingleEpisodeScheme(make_array_scheme(agent, choice, context, LowestCostGraspSelector(context, 1), 1))
