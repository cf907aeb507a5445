"""Values of configurations without their names, so that stored configurations outlive renames of fields."""

from typing import Any


def list_values(settings: Any) -> list[Any]:
    """Return the values of nested dictionaries in their order, without keys."""
    if isinstance(settings, dict):
        return [value for part in settings.values() for value in list_values(part)]
    return [settings]
