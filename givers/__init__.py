"""Policies for the giver, the human side, by name.

`replay` plays the recorded motion; `hesitant`, `hurried` and `noisy` vary it; `stop_when_near`, `cooperative` and
`withdrawing` react to the robot; `learned` was trained, `learned:FILE` by you. Packages add their own through the
entry-point group `handover_marl.givers`.
"""

from typing import cast

from handover_marl import registry
from handover_marl.givers.base import Action, Giver, deviation

GROUP = "handover_marl.givers"

__all__ = ["Action", "Giver", "available", "deviation", "make"]


def available() -> tuple[str, ...]:
    """Names of the givers that can be made."""
    return registry.available(GROUP)


def make(name: str, trust: bool = False) -> Giver:
    """A giver by name.

    Args:
        name: A registered name, or `learned:FILE` for a policy file.
        trust: Whether code in such a file may run.

    Raises:
        UnknownNameError: No giver of this name is registered.
        HandoverError: The file is not there, or is no policy that may be loaded.
    """
    kind, file = registry.load(GROUP, name, Giver)
    return cast(Giver, kind() if file is None else kind(path=file, trust=trust))
