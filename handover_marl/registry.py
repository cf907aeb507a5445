"""Policies by name: the library's own and those that installed packages add through entry points."""

import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from handover_marl.errors import OptionError, UnknownNameError


def available(group: str) -> tuple[str, ...]:
    """Names registered in an entry-point group, sorted."""
    return tuple(sorted({point.name for point in entry_points(group=group)}))


def load(group: str, name: str, base: type) -> tuple[Callable[..., Any], str | None]:
    """The class registered under `name`, and the file to make it from if the name is `name:FILE`.

    Args:
        group: Entry-point group, e.g. `handover_marl.receivers`.
        name: The registered name.
        base: The class that it must derive from.

    Raises:
        UnknownNameError: Nothing is registered under this name.
        OptionError: What is registered cannot be imported, is no subclass of `base`, or takes no file.
    """
    kind = group.rsplit(".", 1)[-1].removesuffix("s")
    registered, _, file = name.partition(":") if isinstance(name, str) else ("", "", "")
    points = entry_points(group=group, name=registered) if registered else ()
    if not points:
        raise UnknownNameError(kind, name, available(group))
    point: EntryPoint = next(iter(points))
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        raise OptionError(
            f"{kind} {name!r} is registered as {point.value} but cannot be imported: {error}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, base)):
        raise OptionError(
            f"{kind} {name!r} ({point.value}) must be a subclass of {base.__module__}.{base.__name__}"
        )
    if file and "path" not in inspect.signature(found).parameters:
        raise OptionError(f"{kind} {registered!r} is not made from a file; leave out ':{file}'")
    return found, file or None
