"""Options that several public functions take: shown where they are passed on, and checked in one place."""

import importlib.util
import inspect
import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

from handover_marl.errors import OptionError

_Function = TypeVar("_Function", bound=Callable[..., Any])


def shows(
    *sources: Callable[..., Any], without: tuple[str, ...] = (), defaults: Mapping[str, Any] = MappingProxyType({})
) -> Callable[[_Function], _Function]:
    """Let a function's signature show, in the place of its `**keywords`, the parameters that these are passed to.

    Args:
        sources: Functions or dataclasses that the keywords go to.
        without: Parameters that are not passed on.
        defaults: Values that parameters have here unless they are given, where these are others.
    """

    def decorate(function: _Function) -> _Function:
        own = inspect.signature(function)
        fixed = [part for part in own.parameters.values() if part.kind is not part.VAR_KEYWORD]
        taken = {part.name for part in fixed} | set(without)
        passed = [
            part.replace(kind=inspect.Parameter.KEYWORD_ONLY, default=defaults.get(part.name, part.default))
            for source in sources
            for part in inspect.signature(source).parameters.values()
            if part.name not in taken
        ]
        function.__signature__ = own.replace(parameters=[*fixed, *passed])  # type: ignore[attr-defined]
        return function

    return decorate


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_workers(workers: int | None) -> int:
    """The number of workers; None takes one a core.

    Raises:
        OptionError: It is not a whole number of at least one.
    """
    if workers is None:
        return available_cores()
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise OptionError(f"workers={workers!r} must be a whole number, 1 or more")
    return workers


def pybullet_installed() -> bool:
    """Whether PyBullet is there, which has no wheels after Python 3.11."""
    return importlib.util.find_spec("pybullet") is not None


def check_pybullet(what: str, instead: str) -> None:
    """Check that PyBullet is there.

    Args:
        what: What needs it.
        instead: What to do without it.

    Raises:
        OptionError: It is not installed.
    """
    if not pybullet_installed():
        raise OptionError(
            f"{what} needs PyBullet, which is not installed (it has wheels up to Python 3.11; pip install pybullet "
            f"compiles it on later ones); {instead}"
        )
