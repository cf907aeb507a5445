"""Self-contained web pages, rendered from Jinja templates with all values escaped."""

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

_ENVIRONMENT = Environment(
    loader=PackageLoader("handover_marl.visualization"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render_page(template: str, **content: Any) -> str:
    """Render a template to a complete web page that loads no other file.

    Args:
        template: Name of a file in `templates/`.
        content: Values of the template's variables.
    """
    return _ENVIRONMENT.get_template(template).render(**content)
