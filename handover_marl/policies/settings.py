"""Numbers of a policy's configuration as options of the policy."""

import math
from collections.abc import Mapping
from dataclasses import is_dataclass, replace
from typing import Any, TypeVar

from handover_marl.errors import OptionError

_Config = TypeVar("_Config")


def override_settings(config: _Config, settings: Mapping[str, object], example: str) -> _Config:
    """Return a copy of a policy's configuration with other values of some of its numbers.

    Args:
        config: Configuration to change, a dataclass.
        settings: Numbers by name: a field of the configuration, such as `near_period`, or a field of one of its parts
            after the name of the part, such as `approach_standoff`.
        example: Name of a setting, for the error message.

    Raises:
        OptionError: A name is not that of a number in the configuration, or a value is not a finite number.
    """
    for name, value in settings.items():
        part, _, field_name = name.partition("_")
        section: Any = getattr(config, part, None)
        is_part = is_dataclass(section)
        known = getattr(section, field_name, None) if is_part else getattr(config, name, None)
        if isinstance(known, bool) or not isinstance(known, (int, float)):
            raise OptionError(
                f"options must be those of the constructor or numbers in {type(config).__name__} such as {example}, "
                f"got {name!r}; see docs/reference/policies.md"
            )
        if isinstance(value, bool) or not isinstance(value, (int, type(known))) or not math.isfinite(value):
            raise OptionError(f"{name} must be a finite {type(known).__name__}, got {value!r}")
        changes: dict[str, Any] = {part: replace(section, **{field_name: value})} if is_part else {name: value}
        config = replace(config, **changes)  # type: ignore[type-var]
    return config
