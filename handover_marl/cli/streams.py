"""Output of the command line: results on stdout, messages on stderr."""

import contextlib
import io
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from handover_marl.cli.options import TableArguments
    from handover_marl.evaluation.reports.tables import TabularResult


def prepare_streams() -> None:
    """Let stdout and stderr escape characters that they cannot encode; discard the output if they are closed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # as in `>&-`; libraries flush the streams, also in worker processes
            # The lowest free descriptor, mostly that of the stream.
            handle = os.open(os.devnull, os.O_WRONLY)
            os.set_inheritable(handle, True)
            setattr(sys, name, os.fdopen(handle, "w", errors="backslashreplace", closefd=False))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def print_tables(result: "TabularResult", tables: "TableArguments", note: str = "") -> None:
    """Print a result in the style of `tables`, then `note`, e.g. the path of a report (for CSV and LaTeX on stderr)."""
    text = result.format(tables.style, tables.columns)
    if tables.style == "markdown":
        print("\n\n".join(filter(None, (text, note))), flush=True)
    else:
        print(text, flush=True)
        if note:
            print_message(note)


def print_message(text: str) -> None:
    """Print a message on stderr, if that is possible."""
    with contextlib.suppress(OSError):
        print(f"handover-marl: {text}", file=sys.stderr, flush=True)


def discard_output() -> None:
    """Discard all further output, so that Python's flush of stdout at exit does not fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
