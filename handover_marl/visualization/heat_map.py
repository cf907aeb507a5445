"""Heat map of the success rates of a cross-play."""

import io
from collections.abc import Sequence

from matplotlib.figure import Figure

# Success rate above which a cell is so dark that its text is white.
_WHITE_TEXT_THRESHOLD = 0.55


def draw_heat_map(
    rates: Sequence[Sequence[float]], givers: Sequence[str], receivers: Sequence[str], title: str
) -> bytes:
    """Draw the success rates of a cross-play as a heat map; return it as PNG.

    Args:
        rates: Success rates (0 to 1), one row per giver and one column per receiver.
        givers: Names of the rows.
        receivers: Names of the columns.
        title: Title of the figure.
    """
    figure = Figure(figsize=(2.6 + 1.3 * len(receivers), 1.9 + 0.55 * len(givers)), dpi=150)
    axes = figure.add_subplot()
    image = axes.imshow(rates, cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(receivers)), receivers)
    axes.set_yticks(range(len(givers)), givers)
    axes.set_xlabel("receiver")
    axes.set_ylabel("giver")
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
