"""Registry of the features by agent and name."""

from typing import Any

import numpy as np
from gymnasium import spaces

from handover_marl.episode.observations import Observation, add_episode_axis
from handover_marl.errors import check_name
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ONLY_ROW, ArrayFactory
from handover_marl.learning.array_features import (
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
from handover_marl.learning.custom_encodings import FEATURES, CustomFeatures, FeaturesLike, Vector, is_reference
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.policies.policy import PolicyContext
from handover_marl.policies.registry import import_reference

_ALL: tuple[type[ArrayFeatures], ...] = (
    *(GiverFeatures, FlatGiverFeatures),
    *(ReceiverFeatures, FlatReceiverFeatures, GraspFeatures, GraspVelocityFeatures),
    *(GraspProximityFeatures, StackedFeatures),
)
_FEATURES = {features.name: features for features in _ALL}


class AgentFeatures:
    """Function from one observation of an agent to a feature vector, without an axis of episodes; see `make_features`.

    Args:
        features: Features of n = 1 episode.

    Attributes:
        name: Name of the features.
        size: Number of features.
        space: Space of the feature vectors, one-dimensional, float32.
    """

    def __init__(self, features: ArrayFeatures) -> None:
        self.name, self.size, self._features = features.name, features.size, features
        self.space = spaces.Box(-np.inf, np.inf, (self.size,), np.float32)

    def reset(self) -> None:
        """Clear the values that features with memory stored in the previous episode."""
        self._features.reset(0)

    def __call__(self, observation: Observation) -> Vector:
        """Return the features (size,) of an observation, float32."""
        vector: Vector = self._features(ONLY_ROW, add_episode_axis(observation))[0]
        return vector


def list_features(agent: str) -> tuple[str, ...]:
    """Return the names of the built-in features of an agent, "giver" or "receiver"."""
    check_name("agent", agent, ("giver", "receiver"))
    return tuple(name for name, features in _FEATURES.items() if features.agent == agent)


def count_features(agent: str, name: str) -> int:
    """Return how many numbers an agent's built-in features `name` have; for others use `make_features(...).size`."""
    check_name(f"{FEATURES} of the {agent}", name, list_features(agent))
    return _FEATURES[name].size


def make_features(agent: str, choice: FeaturesLike, context: PolicyContext) -> AgentFeatures:
    """Make an agent's features, a function with a name, a size and a space.

    Args:
        agent: "giver" or "receiver".
        choice: Name of built-in features; subclass of `FeatureExtractor`; function with a declared size
            (`declare_size`); or text `module:name` of a class or function.
        context: Task and known grasps of the objects, which some features contain.
    """
    return AgentFeatures(make_array_features(agent, choice, context, LowestCostGraspSelector(context, 1), 1))


def make_array_features(
    agent: str,
    choice: FeaturesLike,
    context: PolicyContext,
    selector: LowestCostGraspSelector,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> ArrayFeatures:
    """Make an agent's features for n = `count` episodes; the first three arguments are those of `make_features`.

    Built-in features work on arrays that `arrays` creates, others episode by episode. Some contain the grasps that
    `selector` selects.
    """
    list_features(agent)
    if isinstance(choice, str) and not is_reference(choice):
        count_features(agent, choice)
        return _FEATURES[choice](context, selector, count, arrays)
    own: Any = import_reference(FEATURES, choice) if isinstance(choice, str) else choice
    return CustomFeatures(agent, own, context, count, arrays, choice if isinstance(choice, str) else "")
