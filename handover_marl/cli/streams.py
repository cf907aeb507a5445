"""Output of the command line to streams that may be closed, full, or unable to encode all characters."""

import contextlib
import io
import os
import sys
from typing import TYPE_CHECKING, Literal

from handover_marl.errors import HandoverError

if TYPE_CHECKING:
    from handover_marl.evaluation.reports.tables import TabularResult


class OutputError(HandoverError):
    """Error for results that cannot be printed; files in an output folder are kept."""


def prepare_streams() -> None:
    """Set the streams to print characters that they cannot encode as escape sequences."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def print_result(text: object) -> None:
    """Print a result of a command at once.

    Raises:
        OutputError: Nothing can be printed, e.g. because the disk is full.
        BrokenPipeError: The reader of the output closed it.
    """
    if sys.stdout is None:
        raise OutputError("cannot print the result (standard output is closed); files in --out are complete")
    try:
        print(text, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(
            f"cannot print the result ({error.strerror or error}); files in --out are complete"
        ) from error


def print_tables(result: "TabularResult", table_format: Literal["markdown", "csv", "latex"], note: str) -> None:
    """Print a result and the path of its report; the path goes to stderr if the format is CSV or LaTeX.

    Args:
        result: Result to print.
        table_format: Format of the tables.
        note: Sentence with the path.

    Raises:
        OutputError: Nothing can be printed.
    """
    if table_format == "markdown":
        print_result(f"{result}\n\n{note}")
    else:
        print_result(result.format(table_format))
        print_message(note)


def print_message(text: str) -> None:
    """Print a message on stderr, if that is possible."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            print(f"handover-marl: {text}", file=sys.stderr, flush=True)


def discard_output() -> None:
    """Discard all further output, so that Python's flush of stdout at exit does not fail again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
