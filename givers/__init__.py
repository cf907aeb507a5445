"""Policies for the giver, the human side, by name.

`replay` plays the recorded motion; `hesitant`, `hurried` and `noisy` vary it; `stop_when_near`, `cooperative` and
`withdrawing` react to the robot. Packages add their own through the entry-point group `handover_marl.givers`.
"""

from typing import cast

from handover_marl import registry
from handover_marl.givers.base import Action, Giver, deviation

GROUP = "handover_marl.givers"

__all__ = ["Action", "Giver", "available", "deviation", "make"]


def available() -> tuple[str, ...]:
    """Names of the givers that can be made."""
    return registry.available(GROUP)


def make(name: str) -> Giver:
    """A giver by name.

    Raises:
        UnknownNameError: No giver of this name is registered.
    """
    return cast(type[Giver], registry.load(GROUP, name, Giver))()
