"""Functions that list the references of an HTML page, such as those that lead outside of its folder."""

import re
from html import unescape

_ATTRIBUTE = re.compile(
    r"""(?<![\w-])(?:action|background|cite|data|formaction|href|longdesc|poster|src|srcset)\s*=\s*["']([^"']*)"""
)
_IN_STYLE = re.compile(r"url\(\s*[\"']?([^)\"']+)|@import\s+[\"']?([^\"';]+)", re.IGNORECASE)


def references(page: str) -> list[str]:
    """Return all references of a page and of the pages embedded in it, in order; scripts are left out."""
    found = []
    for part in (page, *(unescape(embedded) for embedded in re.findall(r'srcdoc="(.*?)"', page, re.DOTALL))):
        plain = re.sub(r"<script.*?</script>", "", part, flags=re.DOTALL)
        styles = " ".join(re.findall(r'<style.*?</style>|style="[^"]*"', plain, re.DOTALL))
        sources = re.findall(r"<script\b[^>]*>", part)
        found += _ATTRIBUTE.findall(re.sub(r'srcdoc=".*?"', "", plain, flags=re.DOTALL) + " ".join(sources))
        found += [one or other for one, other in _IN_STYLE.findall(styles)]
    return found


def outside(page: str) -> list[str]:
    """Return the references that are absolute addresses or paths, except embedded data."""
    return [name for name in references(page) if re.match(r"[a-z][a-z0-9+.-]*:|/", name, re.I) and name[:5] != "data:"]


def dangling(page: str) -> list[str]:
    """Return the references to anchors that the page does not have."""
    return [name for name in references(page) if name.startswith("#") and f'id="{name[1:]}"' not in page]
