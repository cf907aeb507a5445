"""User-defined features: base class, features of many episodes, and checks of the returned vectors."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.observations import Observation
from handover_marl.errors import EncodingError, OptionError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory
from handover_marl.learning.array_features import ArrayFeatures
from handover_marl.learning.encodings.choices import (
    MAX_SIZE,
    check_agent,
    check_returned_vector,
    check_size,
    construct_encoding,
    get_choice_name,
    run_custom_code,
    split_episodes,
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


class CustomFeatures(ArrayFeatures):
    """User-defined features, one function for each episode; called one after another with NumPy arrays, and checked.

    Args:
        name: Name of the features.
        functions: Function of each episode from an observation to a feature vector.
        arrays: Creator of the feature vectors.

    Attributes:
        name: Name of the features.
        space: Space of the feature vectors, one-dimensional, float32.

    Raises:
        OptionError: The size is missing or malformed.
    """

    uses_camera = True

    def __init__(self, name: str, functions: Sequence[FeatureFunction], arrays: ArrayFactory) -> None:
        self.name, self.space = name, _read_space(name, functions[0])
        self._functions, self._arrays = functions, arrays
        self._is_bounded = bool(np.isfinite(self.space.low).any() or np.isfinite(self.space.high).any())

    def reset(self, row: int) -> None:
        """Clear the values that the features store from the previous episode, if there are any."""
        reset = getattr(self._functions[row], "reset", None)
        if callable(reset):
            reset()

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the feature vectors (r, m).

        Raises:
            EncodingError: The features fail, or return anything but an element of their space.
        """
        own = split_episodes(rows, observation)
        return self._arrays.asarray(np.stack([self._compute(self._functions[row], one) for row, one in own]))

    def _compute(self, function: FeatureFunction, observation: Observation) -> Vector:
        values = run_custom_code(f"{KIND} {self.name!r}", function, observation)
        advice = "convert with numpy.asarray(values, dtype=numpy.float32), or declare another size"
        checked = check_returned_vector(f"{KIND} {self.name!r}", values, self.space.shape, advice)
        if self._is_bounded and ((values < self.space.low) | (values > self.space.high)).any():
            bad = int(np.flatnonzero((values < self.space.low) | (values > self.space.high))[0])
            raise EncodingError(
                f"{KIND} {self.name!r} must be within their space, got {values[bad]} in component {bad}, whose bounds "
                f"are {self.space.low[bad]} and {self.space.high[bad]}"
            )
        return checked


def make_custom_features(
    agent: str, choice: Any, context: PolicyContext, count: int, arrays: ArrayFactory, name: str = ""
) -> CustomFeatures:
    """Make features of n episodes from a class, an instance or a function that declares its size or space.

    Args:
        agent: "giver" or "receiver".
        choice: Class, instance or function.
        context: Robot, task and known grasps of the objects.
        count: Number n of episodes.
        arrays: Creator of the feature vectors.
        name: Name of the features; default: the name of the class or function.

    Raises:
        OptionError: The size is missing or malformed, or the features are for the other agent.
        EncodingError: The constructor of the class fails.
    """
    if not callable(choice):
        raise OptionError(f"{KIND} must be a name, a class or a function, got {choice!r}")
    name = name or get_choice_name(choice)
    check_agent(KIND, choice, agent)
    functions = [_make_function(choice, context) for _ in range(count)]
    if not callable(functions[0]):
        raise OptionError(f"{KIND} {name!r} must be callable with an observation; add the method __call__")
    return CustomFeatures(name, functions, arrays)


def _make_function(choice: Any, context: PolicyContext) -> Any:
    if isinstance(choice, type):
        return construct_encoding(KIND, choice, context)
    # Environments must not share the memory of an instance.
    return copy.deepcopy(choice) if hasattr(choice, "reset") else choice


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
