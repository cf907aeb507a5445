"""Functions that list the references of an HTML page, such as those that lead outside of its folder."""

import re
from html.parser import HTMLParser

_REFERENCES = {"action", "background", "cite", "data", "formaction", "href", "longdesc", "poster", "src", "srcset"}
_IN_STYLE = re.compile(r"url\(\s*[\"']?([^)\"']+)|@import\s+[\"']?([^\"';]+)", re.IGNORECASE)


class _References(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.ids: set[str] = set()
        self._style = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._style = tag == "style"
        for name, value in attrs:
            if value is None:
                continue
            if name in _REFERENCES:
                self.found.append(value)
            elif name == "srcdoc":
                self.found += references(value)
            elif name == "style":
                self.found += _styled(value)
            elif name == "id":
                self.ids.add(value)

    def handle_data(self, data: str) -> None:
        if self._style:
            self.found += _styled(data)
            self._style = False


def _styled(text: str) -> list[str]:
    return [one or other for one, other in _IN_STYLE.findall(text)]


def references(page: str) -> list[str]:
    """Return all references of a page and of the pages embedded in it, in order."""
    parser = _References()
    parser.feed(page)
    return parser.found


def outside(page: str) -> list[str]:
    """Return the references that are absolute addresses or paths, except embedded data."""
    return [name for name in references(page) if re.match(r"[a-z][a-z0-9+.-]*:|/", name, re.I) and name[:5] != "data:"]


def dangling(page: str) -> list[str]:
    """Return the references to anchors that the page does not have."""
    parser = _References()
    parser.feed(page)
    return [name for name in parser.found if name.startswith("#") and name[1:] not in parser.ids]
