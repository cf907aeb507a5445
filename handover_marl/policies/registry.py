"""Registry of policies by name, and import of a user's code by text `module:name`.

Registered policies are entry points of installed packages. Text that the user passes may import its module. Text from
a file must pass `check_stored_reference` first.
"""

import functools
import importlib
from collections.abc import Container, Iterable
from importlib.metadata import EntryPoints, entry_points
from typing import Any

from handover_marl.errors import OptionError, UnknownNameError, UnsafeFileError, check_name

#: Entry-point group of each agent.
GROUPS = {"giver": "handover_marl.givers", "receiver": "handover_marl.receivers"}


def list_available(agent: str) -> tuple[str, ...]:
    """List the names of all registered policies for an agent, "giver" or "receiver", sorted."""
    return tuple(sorted({point.name for point in _find_points(_get_group(agent))}))


def load_registered(agent: str, name: str) -> type | None:
    """Load the class registered as `name` for a "giver" or "receiver"; None if unknown, OptionError if that fails."""
    group = _get_group(agent)
    points = {point.value: point for point in _find_points(group).select(name=name)} if name else {}
    if len(points) > 1:
        packages = [point.dist.name if point.dist is not None else "an unknown package" for point in points.values()]
        claims = " and ".join(f"{package} ({value})" for package, value in zip(packages, points, strict=True))
        raise OptionError(f"{agent} {name!r} is claimed by {claims}; uninstall one, or pass the class as module:Class")
    for value, point in points.items():
        try:
            found: type = point.load()
        except (ImportError, AttributeError) as error:
            raise OptionError(f"{agent} {name!r} is registered as {value} but cannot be imported: {error}") from error
        return found
    return None


def import_reference(kind: str, text: str, valid: Iterable[str] = ("module:name",)) -> Any:
    """Import the class, function or value that a text `module:name` names; raise UnknownNameError if that fails.

    Args:
        kind: Kind of what is imported, e.g. "features", for error messages.
        text: Text of the form `module:name`, from the user or accepted by `check_stored_reference`.
        valid: Other texts that would be valid, for error messages.
    """
    module, _, name = text.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # importing a user's module may raise anything, and end the process
        reason = f"it cannot be imported ({type(error).__name__}: {error})"
        raise UnknownNameError(kind, text, valid, reason) from error


def check_stored_reference(
    source: object, kind: str, text: str, trust: bool, registered: Container[str] = (), advice: str = ""
) -> None:
    """Check text from a file: raise UnsafeFileError if the text names a module and the user does not trust the file.

    Args:
        source: The file, for error messages.
        kind: Kind of the named thing, e.g. "features", for error messages.
        text: Text in the file: a name with or without options, or `module:name`.
        trust: Whether modules that the file names may be imported.
        registered: Registered names, which may precede ":" and options.
        advice: Another way for the user to allow the import, for error messages.
    """
    head, colon, _ = text.partition(":")
    if colon and head not in registered and not trust:
        raise UnsafeFileError(
            f"{source}: {kind} {text!r} must not be imported from a module that only a file names; {advice}pass "
            "trust=True (--trust) if you know where the file comes from"
        )


@functools.cache
def _find_points(group: str) -> EntryPoints:
    """Return the entry points of a group; this reads files of all installed packages, which takes 10 ms or more."""
    return entry_points(group=group)


def _get_group(agent: str) -> str:
    check_name("agent", agent, GROUPS)
    return GROUPS[agent]
