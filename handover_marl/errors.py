"""What a user can get wrong, as exceptions that say what, where and what to do."""

from collections.abc import Iterable


class HandoverError(Exception):
    """Base of every error this library raises on purpose."""


class DataNotFoundError(HandoverError, FileNotFoundError):
    """A data folder, or a file that must be in it, is missing."""


class DataFormatError(HandoverError, ValueError):
    """A data file is there but cannot be what it should be: truncated, malformed, of the wrong shape."""


class UnsafeFileError(DataFormatError):
    """A pickled file asks for more than numpy arrays and was not loaded."""


class UnknownNameError(HandoverError, ValueError):
    """A setup, split, receiver, giver or other named choice does not exist."""

    def __init__(self, kind: str, name: object, valid: Iterable[str], hint: str = "") -> None:
        names = tuple(valid)
        super().__init__(f"unknown {kind} {name!r}; valid: {', '.join(names)}" + (f"; {hint}" if hint else ""))
        self._arguments = (kind, name, names, hint)

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), self._arguments)


class OptionError(HandoverError, ValueError):
    """An option has a value that cannot work."""


class SceneError(HandoverError, ValueError):
    """A scene id does not exist or lies outside the chosen split."""


class ActionError(HandoverError, ValueError):
    """An action has the wrong shape or type, is not finite, or asks for what the agent may not do."""


class ResetNeededError(HandoverError, RuntimeError):
    """`step`, `render` or `state` was called before `reset`, or `step` after the episode's end."""


class SimulationError(HandoverError, RuntimeError):
    """The physics engine refused something, such as a model file or a window without a screen."""


class WorkerError(HandoverError, RuntimeError):
    """A worker process died."""


class PolicyError(HandoverError, RuntimeError):
    """A policy's own code failed: while it was made, reset, or asked for an action."""


class ResultsError(HandoverError, ValueError):
    """A result folder cannot be read, continued or written."""


class ConformanceError(HandoverError, AssertionError):
    """A policy does not do what the library relies on; raised by `handover_marl.testing`."""
