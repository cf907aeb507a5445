"""Printing of results as tables in the format of the option --format."""

from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from handover_marl.cli.streams import print_message, print_result

if TYPE_CHECKING:
    from handover_marl.evaluation.reports.tables import TabularResult

#: Type of the option --format.
TableFormat = Annotated[Literal["markdown", "csv", "latex"], tyro.conf.arg(name="format")]


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
