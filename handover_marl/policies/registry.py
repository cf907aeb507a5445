"""Names of policies: the library's own and those that installed packages add through entry points."""

from importlib.metadata import EntryPoint, entry_points

from handover_marl.errors import OptionError, UnknownNameError

#: Entry-point groups by agent.
GROUPS = {"giver": "handover_marl.givers", "receiver": "handover_marl.receivers"}


def available(agent: str) -> tuple[str, ...]:
    """Names registered for an agent, sorted.

    Raises:
        UnknownNameError: There is no such agent.
    """
    return tuple(sorted({point.name for point in entry_points(group=_group(agent))}))


def registered(agent: str, name: str) -> type | None:
    """What is registered under a name, or None.

    Raises:
        UnknownNameError: There is no such agent.
        OptionError: It cannot be imported, or several packages claim the name.
    """
    points = {point.value: point for point in entry_points(group=_group(agent), name=name)} if name else {}
    if len(points) > 1:
        claims = " and ".join(f"{_package(point)} ({value})" for value, point in points.items())
        raise OptionError(f"{agent} {name!r} is claimed by {claims}; uninstall one, or name the class itself")
    for value, point in points.items():
        try:
            found: type = point.load()
        except (ImportError, AttributeError) as error:
            raise OptionError(f"{agent} {name!r} is registered as {value} but cannot be imported: {error}") from error
        return found
    return None


def _group(agent: str) -> str:
    if agent not in GROUPS:
        raise UnknownNameError("agent", agent, GROUPS)
    return GROUPS[agent]


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unknown package"
