"""Checks of user-defined features and action schemes: classes, functions, or text `module:name`."""

import inspect
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.errors import EncodingError, HandoverError, OptionError
from handover_marl.geometry.arrays import AnyArray, to_numpy
from handover_marl.policies.policy import PolicyContext

_Function = TypeVar("_Function", bound=Callable[..., Any])
MAX_SIZE = 1_000_000


def declare_size(size: int) -> Callable[[_Function], _Function]:
    """Return a decorator that declares the number of features, or of outputs of an action scheme.

    Args:
        size: Number of features that the function returns, or of outputs that it decodes.

    Raises:
        OptionError: The size is not an integer of at least 1.
    """
    check_size("size", size)

    def decorate(function: _Function) -> _Function:
        function.size = size  # type: ignore[attr-defined]
        return function

    return decorate


def check_size(name: str, size: object) -> int:
    """Check a declared size and return it.

    Args:
        name: Name of the size, for errors.
        size: Value to check.

    Raises:
        OptionError: It is not an integer from 1 to `MAX_SIZE`.
    """
    if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= MAX_SIZE:
        raise OptionError(f"{name} must be an integer from 1 to {MAX_SIZE}, got {size!r}")
    return size


def check_returned_vector(what: str, values: object, shape: tuple[int, ...], advice: str) -> npt.NDArray[np.float32]:
    """Check that user-defined code returned a finite float32 array, and return it.

    Args:
        what: Name of the values, for errors.
        values: Values to check.
        shape: Shape that they must have.
        advice: What to do if they have another type, e.g. "convert with ...".

    Raises:
        EncodingError: The values are no such array.
    """
    if type(values) is not np.ndarray or values.shape != shape or values.dtype != np.float32:
        got = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise EncodingError(f"{what} must be a float32 array of shape {shape}, got {got}; {advice}")
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values))[0])
        raise EncodingError(f"{what} must be finite, got {values[bad]} in component {bad}")
    return values


def is_reference(choice: object) -> bool:
    """Return whether a choice is text of the form `module:name`."""
    return isinstance(choice, str) and ":" in choice


def get_choice_name(choice: object) -> str:
    """Return the name of user-defined features or of a user-defined action scheme, for errors and files."""
    if isinstance(choice, str):
        return choice
    name = getattr(choice, "name", None)
    if isinstance(name, str):
        return name
    return str(getattr(choice, "__qualname__", None) or type(choice).__qualname__)


def check_agent(kind: str, choice: object, agent: str) -> None:
    """Check that user-defined features or a user-defined scheme are for an agent, if they declare one.

    Raises:
        OptionError: They are for another agent.
    """
    declared = getattr(choice, "agent", None)
    if isinstance(declared, str) and declared != agent:
        raise OptionError(
            f"{kind} {get_choice_name(choice)!r} must be for the {agent}, got some for the {declared}; change its "
            "attribute agent"
        )


def construct_encoding(kind: str, choice: type, context: PolicyContext) -> Any:
    """Construct user-defined features or a user-defined scheme from its class, with the context if it takes one.

    Args:
        kind: Kind of the choice, e.g. "features", for errors.
        choice: Class, whose constructor takes `context` or no argument.
        context: Robot, task and known grasps of the objects.

    Raises:
        OptionError: A method is missing.
        EncodingError: The constructor fails.
    """
    name = get_choice_name(choice)
    if inspect.isabstract(choice):
        missing = ", ".join(sorted(choice.__abstractmethods__))  # type: ignore[attr-defined]
        raise OptionError(f"{kind} {name!r} must define {missing}; add the missing methods")
    try:
        takes_context = "context" in inspect.signature(choice).parameters
        return choice(context) if takes_context else choice()
    except Exception as error:  # code of the user
        raise EncodingError(f"{kind} {name!r} cannot be made ({type(error).__name__}: {error})") from error


def run_custom_code(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a user-defined function.

    Raises:
        EncodingError: The function fails.
    """
    try:
        return function(*arguments)
    except HandoverError:
        raise
    except Exception as error:  # code of the user
        raise EncodingError(f"{what} failed ({type(error).__name__}: {error})") from error


def split_episodes(rows: AnyArray, observation: Observation) -> Iterator[tuple[int, Observation]]:
    """Yield the indices (r,) of episodes with a copy of the observation of each as NumPy arrays."""
    own = {key: to_numpy(values) for key, values in observation.items()}
    for number, row in enumerate(rows.tolist()):
        yield row, {key: values[number].copy() for key, values in own.items()}
