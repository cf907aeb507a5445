"""What was found, and how it is told."""

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

_WIDTH, _WHAT_WIDTH = 100, 24  # characters of a line, and of what was looked at


class State(Enum):
    """How something is."""

    GOOD = "ok"
    NOTE = "note"
    FAULT = "fault"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: The thing.
        found: What is there.
        state: Whether that is as it should be; a note keeps nothing from working.
        advice: What to do, if anything.
    """

    what: str
    found: str
    state: State = State.GOOD
    advice: str = ""


def findings_text(findings: Iterable[Finding]) -> str:
    """Findings as lines that fit a terminal, what to do below each."""
    lines = []
    for one in findings:
        lines += _wrapped(one.found, f"{one.state.value:6}{one.what:{_WHAT_WIDTH}}")
        lines += _wrapped(one.advice, " " * (6 + _WHAT_WIDTH) + "-> ") if one.advice else []
    return "\n".join(lines)


def _wrapped(text: str, start: str) -> list[str]:
    return textwrap.wrap(
        text,
        _WIDTH,
        initial_indent=start,
        subsequent_indent=" " * len(start),
        break_long_words=False,
        break_on_hyphens=False,
    )
