"""User-defined features: base class, and checks of the returned vectors."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.observations import Observation
from handover_marl.errors import EncodingError, HandoverError, OptionError
from handover_marl.learning.encodings.choices import (
    MAX_SIZE,
    check_agent,
    check_returned_vector,
    check_size,
    construct_encoding,
    get_choice_name,
)
from handover_marl.policies.policy import PolicyContext

Vector = npt.NDArray[np.float32]
#: Function from an observation to a feature vector.
FeatureFunction = Callable[[Observation], Vector]
KIND = "features"


class FeatureExtractor(ABC):
    """Base class of user-defined features, functions from one agent's observation to a vector.

    Attributes:
        agent: Agent whose observations are used, "giver" or "receiver"; None for either.
        size: Number of features; or `space`, a one-dimensional float32 `gymnasium.spaces.Box`, declares
            their number and bounds.

    Args:
        context: Robot, task and known grasps of the objects.
    """

    agent: str | None = None
    size: int

    def __init__(self, context: PolicyContext) -> None:
        self.context = context

    def reset(self) -> None:  # noqa: B027
        """Clear values that are stored from the previous episode; features without memory need not override it."""

    @abstractmethod
    def __call__(self, observation: Observation) -> Vector:
        """Return the features (size,) of an observation, finite float32 numbers.

        Args:
            observation: Element of the agent's observation space: world frame, m, rad, s, quaternions
                xyzw.
        """


#: Name of built-in features, `module:name`, a class, or a function with a declared size.
FeaturesLike: TypeAlias = str | type[FeatureExtractor] | Callable[[Observation], Any]


class AgentFeatures:
    """Features of one agent with their name and space; made by `features.make_features`.

    Args:
        name: Name of the features.
        space: Space of the feature vectors.
        function: Function from an observation to a feature vector.
        is_checked: Whether each vector is checked against the space.

    Attributes:
        name: Name of the features.
        space: Space of the feature vectors, one-dimensional, float32.
        function: Function from an observation to a feature vector.
    """

    def __init__(self, name: str, space: spaces.Box, function: FeatureFunction, is_checked: bool = False) -> None:
        self.name, self.space, self.function = name, space, function
        self._is_checked = is_checked
        self._is_bounded = bool(np.isfinite(space.low).any() or np.isfinite(space.high).any())

    @property
    def size(self) -> int:
        """Number of features."""
        return int(self.space.shape[0])

    def reset(self) -> None:
        """Clear the values that the features store from the previous episode, if there are any."""
        reset = getattr(self.function, "reset", None)
        if callable(reset):
            reset()

    def __call__(self, observation: Observation) -> Vector:
        """Return the features (size,) of an observation.

        Raises:
            EncodingError: User-defined features fail, or return anything but an element of their space.
        """
        if not self._is_checked:
            return self.function(observation)
        try:
            values = self.function(observation)
        except HandoverError:
            raise
        except Exception as error:  # code of the user
            raise EncodingError(f"{KIND} {self.name!r} failed ({type(error).__name__}: {error})") from error
        self._check(values)
        return values

    def _check(self, values: Any) -> None:
        advice = "convert with numpy.asarray(values, dtype=numpy.float32), or declare another size"
        check_returned_vector(f"{KIND} {self.name!r}", values, self.space.shape, advice)
        if self._is_bounded and ((values < self.space.low) | (values > self.space.high)).any():
            bad = int(np.flatnonzero((values < self.space.low) | (values > self.space.high))[0])
            raise EncodingError(
                f"{KIND} {self.name!r} must be within their space, got {values[bad]} in component {bad}, whose bounds "
                f"are {self.space.low[bad]} and {self.space.high[bad]}"
            )


def make_custom_features(agent: str, choice: Any, context: PolicyContext, name: str = "") -> AgentFeatures:
    """Make checked features from a class, an instance or a function that declares its size or space.

    Args:
        agent: "giver" or "receiver".
        choice: Class, instance or function.
        context: Robot, task and known grasps of the objects.
        name: Name of the features; default: the name of the class or function.

    Raises:
        OptionError: The size is missing or malformed, or the features are for the other agent.
        EncodingError: The constructor of the class fails.
    """
    if not callable(choice):
        raise OptionError(f"{KIND} must be a name, a class or a function, got {choice!r}")
    name = name or get_choice_name(choice)
    check_agent(KIND, choice, agent)
    function = construct_encoding(KIND, choice, context) if isinstance(choice, type) else choice
    if function is choice and hasattr(choice, "reset"):
        # Environments must not share the memory of an instance.
        function = copy.deepcopy(choice)
    if not callable(function):
        raise OptionError(f"{KIND} {name!r} must be callable with an observation; add the method __call__")
    return AgentFeatures(name, _read_space(name, function), function, is_checked=True)


def _read_space(name: str, function: object) -> spaces.Box:
    space, size = getattr(function, "space", None), getattr(function, "size", None)
    if space is not None:
        if not isinstance(space, spaces.Box) or space.dtype != np.float32 or len(space.shape) != 1:
            raise OptionError(f"space of {KIND} {name!r} must be a one-dimensional float32 Box, got {space!r}")
        if space.shape[0] > MAX_SIZE:
            raise OptionError(f"space of {KIND} {name!r} must have at most {MAX_SIZE} components, got {space!r}")
        return space
    if size is None:
        raise OptionError(
            f"{KIND} {name!r} must declare the number of features; add the class attribute size, or "
            "@declare_size(n) above a function"
        )
    return spaces.Box(-np.inf, np.inf, (check_size(f"size of {KIND} {name!r}", size),), np.float32)
