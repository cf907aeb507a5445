"""Numbers of a policy's configuration as options of the policy."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from handover_marl.errors import OptionError

_Config = TypeVar("_Config")


def override_options(config: _Config, options: Mapping[str, object], example: str) -> _Config:
    """Return a copy of a policy's configuration with other values of some of its numbers.

    Args:
        config: Configuration to change, a dataclass.
        options: Numbers by name: a field of the configuration, such as `near_period`, or a field of one of its
            sections after the name of the section, such as `approach_standoff`.
        example: Name of an option, for the error message.

    Raises:
        OptionError: A name is not that of a number in the configuration, or a value is not a finite number.
    """
    changed: Any = config
    for name, value in options.items():
        section_name = _find_section(changed, name)
        section = getattr(changed, section_name) if section_name else changed
        field_name = name[len(section_name) + 1 :] if section_name else name
        known = getattr(section, field_name, None)
        if isinstance(known, bool) or not isinstance(known, (int, float)):
            raise OptionError(
                f"options must be those of the constructor or numbers in {type(config).__name__} such as {example}, "
                f"got {name!r}; see docs/reference/policies.md"
            )
        if isinstance(value, bool) or not isinstance(value, (int, type(known))) or not math.isfinite(value):
            raise OptionError(f"{name} must be a finite {type(known).__name__}, got {value!r}")
        section = replace(section, **{field_name: value})
        changed = replace(changed, **{section_name: section}) if section_name else section
    return changed  # type: ignore[no-any-return]


def _find_section(config: Any, name: str) -> str:
    """Return the name of the section to which an option belongs, "" if it is a field of the configuration itself."""
    # Names of sections have underscores, too: of `quick` and `quick_preparation`, the longer one counts.
    names = [field.name for field in fields(config) if is_dataclass(getattr(config, field.name))]
    return max((section_name for section_name in names if name.startswith(f"{section_name}_")), key=len, default="")
