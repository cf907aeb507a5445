"""Heat map of the success rates of pairs of policies."""

import io
import textwrap
from collections.abc import Sequence

from matplotlib.figure import Figure

# Success rate above which a cell is so dark that its text is white.
_WHITE_TEXT_THRESHOLD = 0.55
# Number of characters above which names of columns are rotated, so that they do not overlap.
_MAX_HORIZONTAL_TEXT = 16
# Longest line, and most lines, of the name of a policy with many options.
_MAX_LINE, _MAX_LINES = 30, 3


def draw_heat_map(
    rates: Sequence[Sequence[float]],
    rows: Sequence[str],
    columns: Sequence[str],
    title: str,
    axis_labels: tuple[str, str] = ("giver", "receiver"),
) -> bytes:
    """Draw success rates of pairs of policies as a heat map; return it as PNG.

    Args:
        rates: Success rates (0 to 1), by row and column.
        rows: Names of the rows; long names are wrapped and cut off.
        columns: Names of the columns; likewise.
        title: Title of the figure.
        axis_labels: What the rows and the columns are.
    """
    rows, columns = ([_wrap_name(name) for name in names] for names in (rows, columns))
    figure = Figure(figsize=(2.6 + 1.3 * len(columns), 1.9 + 0.55 * len(rows)), dpi=150)
    axes = figure.add_subplot()
    image = axes.imshow(rates, cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
    if max(len(line) for name in columns for line in name.splitlines()) > _MAX_HORIZONTAL_TEXT:
        axes.set_xticks(range(len(columns)), columns, rotation=30, ha="right", rotation_mode="anchor")
    else:
        axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_ylabel(axis_labels[0])
    axes.set_xlabel(axis_labels[1])
    for row, line in enumerate(rates):
        for column, rate in enumerate(line):
            color = "white" if rate > _WHITE_TEXT_THRESHOLD else "black"
            axes.text(column, row, f"{100 * rate:.0f} %", ha="center", va="center", color=color)
    axes.set_title(title, fontsize=8)
    figure.colorbar(image, ax=axes, label="success")
    figure.tight_layout()
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _wrap_name(name: str) -> str:
    """Return a name with line breaks between options, cut off after `_MAX_LINES` lines."""
    lines = textwrap.wrap(
        name.replace(",", ", ").replace(":", ": "), _MAX_LINE, max_lines=_MAX_LINES, placeholder=" ..."
    )
    return "\n".join(lines)
