"""Functions that list the references of an HTML page, such as those that lead outside of its folder."""

import re
from html import unescape

_REFERENCE = re.compile(r"""(?<![\w-])(?:href|src|data|poster|action)\s*=\s*["']([^"']*)|url\(\s*["']?([^)"']+)""")


def references(page: str) -> list[str]:
    """Return all references of a page and of the pages embedded in it, in order; the code of scripts is left out."""
    parts = [re.sub(r'srcdoc=".*?"', "", page, flags=re.DOTALL)]
    parts += [unescape(embedded) for embedded in re.findall(r'srcdoc="(.*?)"', page, re.DOTALL)]
    plain = [re.sub(r"(<script[^>]*>).*?</script>", r"\1", part, flags=re.DOTALL) for part in parts]
    return [one or other for part in plain for one, other in _REFERENCE.findall(part)]


def outside(page: str) -> list[str]:
    """Return the references that are absolute addresses or paths, except embedded data."""
    return [name for name in references(page) if re.match(r"[a-z][a-z0-9+.-]*:|/", name, re.I) and name[:5] != "data:"]


def dangling(page: str) -> list[str]:
    """Return the references to anchors that the page does not have."""
    return [name for name in references(page) if name.startswith("#") and f'id="{name[1:]}"' not in page]
