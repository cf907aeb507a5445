"""Registry of policies by name, read from the entry points of installed packages."""

import importlib
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from handover_marl.errors import OptionError, UnknownNameError, check_name

#: Entry-point group of each agent.
GROUPS = {"giver": "handover_marl.givers", "receiver": "handover_marl.receivers"}


def list_available(agent: str) -> tuple[str, ...]:
    """List the names of all registered policies for an agent, sorted.

    Raises:
        UnknownNameError: There is no such agent.
    """
    return tuple(sorted({point.name for point in entry_points(group=_get_group(agent))}))


def load_registered(agent: str, name: str) -> type | None:
    """Load the policy class that is registered under a name; None for an unknown name.

    Raises:
        UnknownNameError: There is no such agent.
        OptionError: The class cannot be imported, or several packages register the name.
    """
    group = _get_group(agent)
    points = {point.value: point for point in entry_points(group=group, name=name)} if name else {}
    if len(points) > 1:
        claims = " and ".join(f"{_get_package(point)} ({value})" for value, point in points.items())
        raise OptionError(f"{agent} {name!r} is claimed by {claims}; uninstall one, or pass the class as module:Class")
    for value, point in points.items():
        try:
            found: type = point.load()
        except (ImportError, AttributeError) as error:
            raise OptionError(f"{agent} {name!r} is registered as {value} but cannot be imported: {error}") from error
        return found
    return None


def import_policy(agent: str, module: str, attribute: str) -> Any:
    """Import a policy, given as a module's name and an attribute of it.

    Raises:
        UnknownNameError: The module or its attribute cannot be imported.
    """
    try:
        return getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:  # importing a user's module may raise anything, and end the process
        reason = f"{type(error).__name__}: {error}" if isinstance(error, SystemExit) else error
        raise UnknownNameError(
            agent, f"{module}:{attribute}", list_available(agent), f"and it cannot be imported ({reason})"
        ) from error


def _get_group(agent: str) -> str:
    check_name("agent", agent, GROUPS)
    return GROUPS[agent]


def _get_package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unknown package"
