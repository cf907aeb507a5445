"""Pages of the documentation, and functions that read their code blocks and tables."""

import functools
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt
from markdown_it.token import Token

REPOSITORY = Path(__file__).parents[2]
_SITE = sorted(path for path in (REPOSITORY / "docs").rglob("*.md") if path.parent.name != "source")
PAGES = (REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *_SITE)
#: Inline code that begins with one of these is checked as a command; without arguments it is only a name.
_COMMANDS = ("handover-marl ", "python ", "make ")
_MARK = "<!-- checked: "


class Block(NamedTuple):
    """Block of code in a page: file, line at which the code starts (from 1), language of the fence, and code."""

    page: Path
    line: int
    language: str
    text: str


def name(page: Path) -> str:
    """Return the name of a page in tests: its path in the repository."""
    return page.relative_to(REPOSITORY).as_posix()


def blocks(page: Path, language: str | None = None) -> list[Block]:
    """Return the fenced and indented code blocks of a page, in order, of one language or of all."""
    found = [
        Block(page, _line(token) + 1, token.info.strip(), token.content)
        for token in _tokens(page)
        if token.type in ("fence", "code_block")
    ]
    return [block for block in found if language is None or block.language == language]


def inline_commands(page: Path) -> list[Block]:
    """Return the commands with arguments that a page has as inline code."""
    found = []
    for token in _tokens(page):
        for child in token.children or ():
            if child.type == "code_inline" and child.content.startswith(_COMMANDS):
                found.append(Block(page, _line(token), "bash", " ".join(child.content.split())))
    return found


def checked_table(page: Path, mark: str) -> list[list[str]]:
    """Return the rows below the header of the table that follows `<!-- checked: MARK -->`."""
    tokens = _tokens(page)
    marks = [number for number, token in enumerate(tokens) if token.content.strip() == f"{_MARK}{mark} -->"]
    assert len(marks) == 1, f"{name(page)} has {len(marks)} tables that are marked {mark!r}"
    rows: list[list[str]] = []
    for token in tokens[marks[0] :]:
        if token.type == "table_close":
            return rows[1:]
        if token.type == "tr_open":
            rows.append([])
        elif token.type == "inline" and rows:
            rows[-1].append(token.content)
    raise AssertionError(f"{name(page)}: no table follows the mark {mark!r}")


def marks(page: Path) -> set[str]:
    """Return the marks of a page's checked tables."""
    found = (token.content.strip() for token in _tokens(page) if token.type == "html_block")
    return {text.removeprefix(_MARK).removesuffix(" -->") for text in found if text.startswith(_MARK)}


@functools.cache
def _tokens(page: Path) -> list[Token]:
    return MarkdownIt("commonmark").enable("table").parse(page.read_text())


def _line(token: Token) -> int:
    """Return the first line of a token, from 1; for fenced code this is the line of the backticks."""
    return 1 + (token.map[0] if token.map else 0)
