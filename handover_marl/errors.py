"""Exceptions of the library; messages name the argument, the rule and the remedy."""

import contextlib
import difflib
import sysconfig
import traceback
from collections.abc import Collection, Iterable, Iterator
from numbers import Integral
from pathlib import Path

# Folders of this library, of Python's own, and of installed ones.
_LIBRARIES = [Path(__file__).parent, *(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib"))]


class HandoverError(Exception):
    """Base class of all errors that the library raises on purpose."""


class DataNotFoundError(HandoverError, FileNotFoundError):
    """Error for a data folder or a required file, such as a policy file, that does not exist or cannot be read."""


class DataFormatError(HandoverError, ValueError):
    """Error for a data file that is truncated, malformed or of the wrong shape."""


class UnsafeFileError(DataFormatError):
    """Error for a file that could run code (a pickle of unexpected objects, or a module's name); no code was run."""


class UnknownNameError(HandoverError, ValueError):
    """Error for a setup, split, policy or other choice that does not exist.

    Args:
        kind: Kind of the choice, e.g. "split".
        name: Unknown name.
        valid: Valid names.
        hint: Further advice at the end of the message; "" for none.
    """

    def __init__(self, kind: str, name: object, valid: Iterable[object], hint: str = "") -> None:
        names = tuple(map(str, valid))
        advice = [text for text in (hint, suggest_name(name, names)) if text]
        super().__init__("; ".join([f"unknown {kind} {name!r}", f"valid: {', '.join(names)}", *advice]))
        self._arguments = (kind, name, names, hint)

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), self._arguments)


class UnknownArgumentError(HandoverError, TypeError):
    """Error for a keyword argument that a function does not have.

    Args:
        function: Name of the function; or the complete message, if `name` is left out.
        name: Name of the unknown argument.
        valid: Names of the function's arguments.
    """

    def __init__(self, function: str, name: str = "", valid: Iterable[str] = ()) -> None:
        # Gymnasium's `make` creates the error anew from its message.
        names, message = tuple(valid), f"{function}() got an unexpected keyword argument {name!r}" if name else function
        super().__init__("; ".join(filter(None, [message, suggest_name(name, names)])))
        self._arguments = (function, name, names)

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), self._arguments)


def suggest_name(name: object, valid: Iterable[str]) -> str:
    """Return "did you mean 'NAME'?" with the valid name most similar to a misspelt one, or "" if none is similar."""
    similar = difflib.get_close_matches(name, list(valid), n=1) if isinstance(name, str) else []
    return f"did you mean {similar[0]!r}?" if similar else ""


def check_name(kind: str, name: object, valid: Iterable[object]) -> None:
    """Check that `name`, a text or integer, is one of the `valid` ones; error messages call it a `kind`, e.g. "split".

    Raises:
        UnknownNameError: The name is not valid.
    """
    choices = tuple(valid)
    if not isinstance(name, (str, Integral)) or name not in choices:
        raise UnknownNameError(kind, name, choices)


class OptionError(HandoverError, ValueError):
    """Error for an option that is out of range, contradicts other options, or needs a package that is not installed."""


class SceneError(HandoverError, ValueError):
    """Error for a scene number that does not exist or is not in the split."""


class ActionError(HandoverError, ValueError):
    """Error for a policy's or caller's action of the wrong shape or type, or with values that are not finite."""


class RewardError(HandoverError, ValueError):
    """Error for a user-defined reward that fails, or that returns a term with a wrong agent, name or value."""


class EncodingError(HandoverError, ValueError):
    """Error for user-defined features or action schemes that fail, or return an array of wrong size, type or values."""


class ResetNeededError(HandoverError, RuntimeError):
    """Error for a call on an environment or a policy that must be reset first, or on a closed environment."""


class SimulationError(HandoverError, RuntimeError):
    """Error of the simulation, e.g. for a damaged model file, or for an environment that two threads use at once."""


class WorkerError(HandoverError, RuntimeError):
    """Error for a worker process or Ray cluster that died, cannot be reached, or failed in a task."""


class PolicyError(HandoverError, RuntimeError):
    """Error for a policy whose code fails when it is made, reset or called, or is missing or different on a machine."""


class ResultsError(HandoverError, ValueError):
    """Error for a result folder or another output file that cannot be read, resumed or written."""


class ConformanceError(HandoverError, AssertionError):
    """Error for a policy that fails a conformance test of `handover_marl.testing`."""


@contextlib.contextmanager
def report_failure(kind: type[HandoverError], label: str, keys: Collection[str] = ()) -> Iterator[None]:
    """Raise errors of a user's code in a `with` block as errors of class `kind`, with a label, file and line.

    Errors of this library stay as they are. With a `KeyError`, the message names the valid `keys`, if there are any.
    """
    try:
        yield
    except HandoverError:
        raise
    except (Exception, SystemExit) as error:
        frames = [(Path(frame.filename), frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
        own = [each for each in frames if not any(map(each[0].is_relative_to, _LIBRARIES))]
        place = f" ({own[-1][0].name}, line {own[-1][1]})" if own else ""
        names = f"; the keys are {', '.join(keys)}" if isinstance(error, KeyError) and keys else ""
        raise kind(f"{label} failed: {type(error).__name__}: {error}{place}{names}") from error
