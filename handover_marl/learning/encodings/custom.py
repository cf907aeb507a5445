"""User-defined features and action schemes: classes, or functions with a declared size."""

import copy
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.errors import EncodingError, OptionError, report_failure
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, to_numpy
from handover_marl.learning.encodings.action_scheme import ActionScheme, ArrayScheme, Outputs
from handover_marl.learning.encodings.features import ArrayFeatures
from handover_marl.policies.policy import Action, PolicyContext

FEATURES, SCHEME = "features", "action scheme"
_ACTION_SIZES = {"giver": GIVER_ACTION_SIZE, "receiver": PANDA_DOF}
_Function = TypeVar("_Function", bound=Callable[..., Any])
Vector = npt.NDArray[np.float32]


def declare_size(size: int) -> Callable[[_Function], _Function]:
    """Return a decorator that declares the size of a user-defined feature function or action scheme.

    Args:
        size: Number of features that the function returns, or of network outputs that it decodes.

    Raises:
        OptionError: The size is not an integer of at least 1.
    """
    _check_size("features or outputs", size)

    def decorate(function: _Function) -> _Function:
        function.size = size  # type: ignore[attr-defined]
        return function

    return decorate


def is_reference(choice: object) -> bool:
    """Return whether a choice of features or of an action scheme is text of the form `module:name`."""
    return isinstance(choice, str) and ":" in choice


class FeatureExtractor(ABC):
    """Base class of user-defined features, functions from one agent's observation to a vector.

    Attributes:
        agent: Agent whose observations are used, "giver" or "receiver"; None for either.
        size: Number of features.

    Args:
        context: Robot, task and known grasps of the objects.
    """

    agent: str | None = None
    size: int

    def __init__(self, context: PolicyContext) -> None:
        self.context = context

    def reset(self) -> None:  # noqa: B027
        """Clear values that are stored from the previous episode; features that store none need not define it."""

    @abstractmethod
    def __call__(self, observation: Observation) -> Vector:
        """Return the features (size,) of an observation, finite float32 numbers.

        Args:
            observation: Element of the agent's observation space: world frame, m, rad, s, quaternions xyzw.
        """


#: Name of built-in features, `module:name`, a class, or a function with a declared size.
FeaturesLike: TypeAlias = str | type[FeatureExtractor] | Callable[[Observation], Any]
#: Function from outputs (size,) in [-1, 1] and an observation to an action.
SchemeFunction: TypeAlias = Callable[[Outputs, Observation], Action]
#: Name of a built-in scheme, `module:name`, a class, or a function with a declared size.
SchemeLike: TypeAlias = str | type[ActionScheme] | SchemeFunction


class CustomFeatures(ArrayFeatures):
    """User-defined features of n episodes: one callable for each, called one after another; results are checked.

    Args:
        agent: "giver" or "receiver".
        choice: Subclass of `FeatureExtractor`, or instance or function with a declared size (`declare_size`).
        context: Robot, task and known grasps of the objects.
        count: Number n of episodes.
        arrays: Factory of the feature vectors; the user's code gets and returns NumPy arrays.
        name: Name of the features; default: the name of the class or function.
    """

    uses_camera = True

    def __init__(
        self, agent: str, choice: Any, context: PolicyContext, count: int, arrays: ArrayFactory, name: str = ""
    ) -> None:
        if not callable(choice):
            raise OptionError(f"{FEATURES} must be a name, a class or a function, got {choice!r}")
        self.agent, self.name, self._arrays = agent, name or _get_name(choice), arrays
        self._label = f"{FEATURES} {self.name!r}"
        self._functions = _make_instances(FEATURES, agent, choice, context, count)
        self.size = _check_size(self._label, getattr(self._functions[0], "size", None), "features")

    def reset(self, row: int) -> None:
        """Call the method `reset` of the features of the episode with index `row`, if they have it."""
        _run(self._label, getattr(self._functions[row], "reset", lambda: None))

    def __call__(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the feature vectors (r, size), float32, of the episodes with indices `rows`."""
        found = [
            _check_vector(self._label, _run(self._label, self._functions[row], one), self.size)
            for row, one in _split_episodes(rows, observation)
        ]
        return self._arrays.asarray(np.stack(found))


class _FunctionScheme(ActionScheme):
    """Action scheme that decodes by a function from outputs and observation to an action."""

    def __init__(self, function: Any) -> None:
        self._function, self.size = function, function.size  # type: ignore[misc]
        super().reset()

    def reset(self) -> None:
        super().reset()
        getattr(self._function, "reset", lambda: None)()

    def compute_action(self, observation: Observation) -> Action:
        action: Action = self._function(self.outputs, observation)
        return action


class CustomScheme(ArrayScheme):
    """User-defined action scheme of n episodes: one instance for each, called one after another; actions are checked.

    Args:
        agent: "giver" or "receiver".
        choice: Subclass of `ActionScheme`; or function from outputs and observation to an action, with a declared size.
        context, count, arrays, name: As for `CustomFeatures`.
    """

    def __init__(
        self, agent: str, choice: Any, context: PolicyContext, count: int, arrays: ArrayFactory, name: str = ""
    ) -> None:
        if not callable(choice) or (isinstance(choice, type) and not issubclass(choice, ActionScheme)):
            raise OptionError(
                f"{SCHEME} must be a name, a subclass of handover_marl.ActionScheme or a function, got {choice!r}"
            )
        self.agent, self.name = agent, name or _get_name(choice)  # type: ignore[misc]
        self._label, self._arrays = f"{SCHEME} {self.name!r}", arrays
        self.size = _check_size(self._label, getattr(choice, "size", None), "outputs")
        found = _make_instances(SCHEME, agent, choice, context, count)
        self._schemes: Sequence[ActionScheme] = found if isinstance(choice, type) else list(map(_FunctionScheme, found))

    @property
    def wait(self) -> float:
        """Time at the start of an episode during which the agent does not act, the same in all n episodes (s)."""
        return self._schemes[0].wait

    @wait.setter
    def wait(self, wait: float) -> None:
        for scheme in self._schemes:
            scheme.wait = wait

    def reset(self, row: int) -> None:
        """Clear the state of the scheme of the episode with index `row`."""
        _run(self._label, self._schemes[row].reset)

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the network must be evaluated now, (r,), for the r episodes with indices `rows`."""
        own = _split_episodes(rows, observation)
        needs = [bool(_run(self._label, self._schemes[row].needs_outputs, one)) for row, one in own]
        return self._arrays.asarray(needs, "bool")

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Pass outputs (r, size) to the schemes of the episodes `rows`; most schemes clip them to [-1, 1]."""
        for row, own in zip(rows.tolist(), to_numpy(outputs), strict=True):
            _run(self._label, self._schemes[row].set_outputs, own)

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the actions of the episodes with indices `rows`, float32: (r, 8) of givers or (r, 9) of receivers."""
        label, size = f"action of {self._label}", _ACTION_SIZES[self.agent]
        found = [
            _check_vector(label, _run(self._label, self._schemes[row].compute_action, one), size)
            for row, one in _split_episodes(rows, observation)
        ]
        return self._arrays.asarray(np.stack(found))


def _check_size(name: str, size: object, unit: str = "") -> int:
    """Return the size; raise OptionError unless it is an integer of at least 1. `name` and `unit` are for errors."""
    if size is None:
        raise OptionError(
            f"{name} must declare the number of {unit}; add the attribute size, or @declare_size(n) above a function"
        )
    if isinstance(size, bool) or not isinstance(size, int) or size < 1:
        raise OptionError(f"size of {name} must be an integer of at least 1, got {size!r}")
    return size


def _get_name(choice: object) -> str:
    """Return the name of user-defined features or of a user-defined action scheme, for errors and files."""
    name = getattr(choice, "name", None)
    return name if isinstance(name, str) else str(getattr(choice, "__qualname__", None) or type(choice).__qualname__)


def _make_instances(kind: str, agent: str, choice: Any, context: PolicyContext, count: int) -> list[Any]:
    """Return a list of `count` callables: instances of a class, one function repeated, or copies of an object.

    Objects are copied only if they have a method `reset`. A `kind` such as "features" is for errors.
    """
    label, declared = f"{kind} {_get_name(choice)!r}", getattr(choice, "agent", None)
    if isinstance(declared, str) and declared != agent:
        raise OptionError(f"{label} must be for the {agent}, got some for the {declared}; change its attribute agent")
    if inspect.isfunction(choice) and hasattr(choice, "reset"):
        raise OptionError(f"{label} with a reset must be a class, got a function; write a class")
    if inspect.isabstract(choice):
        missing = ", ".join(sorted(choice.__abstractmethods__))
        raise OptionError(f"{label} must define {missing}; add the missing methods")
    try:
        if not isinstance(choice, type):
            return [copy.deepcopy(choice) if hasattr(choice, "reset") else choice for _ in range(count)]
        given = (context,) if "context" in inspect.signature(choice).parameters else ()
        return [choice(*given) for _ in range(count)]
    except Exception as error:  # code of the user
        raise EncodingError(f"{label} cannot be made ({type(error).__name__}: {error})") from error


def _check_vector(label: str, values: Any, size: int) -> Vector:
    """Check that user-defined code returned finite float32 numbers (size,), and return them."""
    if type(values) is not np.ndarray or values.shape != (size,) or values.dtype != np.float32:
        got = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise EncodingError(
            f"{label} must be a float32 array of shape {(size,)}, got {got}; convert with astype, or declare its size"
        )
    if not np.isfinite(values).all():
        bad = int(np.argmin(np.isfinite(values)))
        raise EncodingError(f"{label} must be finite, got {values[bad]} in component {bad}")
    return values


def _run(label: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of user-defined code; raise its exceptions as EncodingErrors that begin with `label`."""
    with report_failure(EncodingError, label):
        return function(*arguments)


def _split_episodes(rows: AnyArray, observation: Observation) -> Iterator[tuple[int, Observation]]:
    """Yield the index of each of r episodes, from `rows`, with a copy of its observation as NumPy arrays."""
    own = {key: to_numpy(values) for key, values in observation.items()}
    for number, row in enumerate(rows.tolist()):
        yield row, {key: values[number].copy() for key, values in own.items()}
