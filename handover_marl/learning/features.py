"""Registry of the features by agent and name."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces

from handover_marl.episode.observations import Observation, add_episode_axis, giver_observation_space, state_space
from handover_marl.errors import check_name
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ONLY_ROW, ArrayFactory
from handover_marl.geometry.ycb import LARGEST_YCB_CLASS
from handover_marl.learning.array_features import (
    N_STACKED,
    ArrayFeatures,
    FlatFeatures,
    GiverFeatures,
    GraspFeatures,
    GraspProximityFeatures,
    ReceiverFeatures,
    StackedFeatures,
)
from handover_marl.learning.custom_encodings import FEATURES, CustomFeatures, FeaturesLike, Vector, is_reference
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.policies.policy import PolicyContext
from handover_marl.policies.registry import import_reference

# Function of context, selector of grasps, number of episodes and creator of the arrays.
_Make: TypeAlias = Callable[[PolicyContext, LowestCostGraspSelector, int, ArrayFactory], ArrayFeatures]

_N_RECEIVER, _N_GRASP, _N_PROXIMITY = 35 + LARGEST_YCB_CLASS, 8, 12
_GIVER_SPACE, _RECEIVER_SPACE = giver_observation_space(), state_space()

# By agent and name: factory and number of features. The flat ones are complete observations in the order in which
# Gymnasium and Stable-Baselines3 flatten them.
_FEATURES: dict[str, dict[str, tuple[_Make, int]]] = {
    "giver": {
        "giver": (lambda context, selector, count, arrays: GiverFeatures(context, arrays), 18 + LARGEST_YCB_CLASS),
        "flat_giver": (lambda *_: FlatFeatures(_GIVER_SPACE), spaces.flatdim(_GIVER_SPACE)),
    },
    "receiver": {
        "receiver": (lambda context, selector, count, arrays: ReceiverFeatures(context, arrays), _N_RECEIVER),
        "flat_receiver": (lambda *_: FlatFeatures(_RECEIVER_SPACE), spaces.flatdim(_RECEIVER_SPACE)),
        "grasp": (
            lambda context, selector, count, arrays: GraspFeatures(context, selector, arrays),
            _N_RECEIVER + _N_GRASP,
        ),
        "close": (
            lambda context, selector, count, arrays: GraspProximityFeatures(context, selector, arrays),
            _N_PROXIMITY,
        ),
        "close_stack": (
            lambda context, selector, count, arrays: StackedFeatures(
                GraspProximityFeatures(context, selector, arrays), _N_PROXIMITY, count, arrays
            ),
            N_STACKED * _N_PROXIMITY,
        ),
    },
}


class AgentFeatures:
    """Features of one agent in one episode, without the axis of episodes; made by `make_features`.

    Args:
        name: Name of the features.
        space: Space of the feature vectors.
        features: Features of n = 1 episode.

    Attributes:
        name: Name of the features.
        space: Space of the feature vectors, one-dimensional, float32.
    """

    def __init__(self, name: str, space: spaces.Box, features: ArrayFeatures) -> None:
        self.name, self.space, self._features = name, space, features

    @property
    def size(self) -> int:
        """Number of features."""
        return int(self.space.shape[0])

    def reset(self) -> None:
        """Clear the values that are stored from the previous episode."""
        self._features.reset(0)

    def __call__(self, observation: Observation) -> Vector:
        """Return the features (size,) of an observation.

        Raises:
            EncodingError: User-defined features fail, or return anything but an element of their space.
        """
        vector: Vector = self._features(ONLY_ROW, add_episode_axis(observation))[0]
        return vector


def list_features(agent: str) -> tuple[str, ...]:
    """Return the names of an agent's built-in features.

    Raises:
        UnknownNameError: There is no such agent.
    """
    check_name("agent", agent, _FEATURES)
    return tuple(_FEATURES[agent])


def count_features(agent: str, name: str) -> int:
    """Return the length of an agent's feature vector; user-defined features have `make_features(...).size`.

    Raises:
        UnknownNameError: The agent is unknown or has no features of that name.
    """
    check_name(f"{FEATURES} of the {agent}", name, list_features(agent))
    return _FEATURES[agent][name][1]


def make_features(agent: str, choice: FeaturesLike, context: PolicyContext) -> AgentFeatures:
    """Make an agent's features, a function with a name, a size and a space.

    Args:
        agent: "giver" or "receiver".
        choice: Name of built-in features; subclass of `FeatureExtractor`; function with a declared size
            (`declare_size`); or text `module:name` of a class or function.
        context: Task and known grasps of the objects, which some features contain.

    Raises:
        UnknownNameError: The agent is unknown or has no features of that name.
        OptionError: User-defined features declare no size, or are for the other agent.
        EncodingError: The constructor of user-defined features fails.
    """
    found = make_array_features(agent, choice, context, LowestCostGraspSelector(context, 1), 1)
    if isinstance(found, CustomFeatures):
        return AgentFeatures(found.name, found.space, found)
    size = count_features(agent, str(choice))
    return AgentFeatures(str(choice), spaces.Box(-np.inf, np.inf, (size,), np.float32), found)


def make_array_features(
    agent: str,
    choice: FeaturesLike,
    context: PolicyContext,
    selector: LowestCostGraspSelector,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> ArrayFeatures:
    """Make an agent's features for n episodes: built-in features work on arrays, others episode by episode.

    Args:
        agent: "giver" or "receiver".
        choice: Features, see `make_features`.
        context: Robot, task and known grasps of the objects.
        selector: Selector of grasps.
        count: Number n of episodes.
        arrays: Creator of the arrays.
    """
    list_features(agent)
    if isinstance(choice, str) and not is_reference(choice):
        check_name(f"{FEATURES} of the {agent}", choice, list_features(agent))
        return _FEATURES[agent][choice][0](context, selector, count, arrays)
    own: Any = import_reference(FEATURES, choice) if isinstance(choice, str) else choice
    return CustomFeatures(agent, own, context, count, arrays, choice if isinstance(choice, str) else "")
