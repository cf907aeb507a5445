"""Pages from templates. Whatever comes from names, files or results is escaped."""

import functools
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def page(template: str, **content: Any) -> str:
    """A complete page that loads nothing.

    Args:
        template: Name of a file in `templates/`.
        content: What the template names.
    """
    return _environment().get_template(template).render(**content)


@functools.cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("handover_marl.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
