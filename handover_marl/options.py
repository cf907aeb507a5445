"""Keywords that several public functions pass on, typed once, and shown where they are taken."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])


def shows(*sources: Callable[..., Any], without: tuple[str, ...] = ()) -> Callable[[_Function], _Function]:
    """Let a function's signature show, in the place of its `**keywords`, the parameters that these are passed to.

    Args:
        sources: Functions or dataclasses that the keywords go to.
        without: Parameters that are not passed on.
    """

    def decorate(function: _Function) -> _Function:
        own = inspect.signature(function)
        fixed = [part for part in own.parameters.values() if part.kind is not part.VAR_KEYWORD]
        taken = {part.name for part in fixed} | set(without)
        passed = [
            part.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for source in sources
            for part in inspect.signature(source).parameters.values()
            if part.name not in taken
        ]
        function.__signature__ = own.replace(parameters=[*fixed, *passed])  # type: ignore[attr-defined]
        return function

    return decorate
