"""Cross-play as a picture."""

import io
from collections.abc import Sequence

from matplotlib.figure import Figure

# Cells darker than this share of success carry white letters.
_DARK = 0.55


def heat_map(rates: Sequence[Sequence[float]], givers: Sequence[str], receivers: Sequence[str], title: str) -> bytes:
    """A PNG of success rates (0..1), givers down, receivers across."""
    figure = Figure(figsize=(2.6 + 1.3 * len(receivers), 1.9 + 0.55 * len(givers)), dpi=150)
    axes = figure.add_subplot()
    picture = axes.imshow(rates, cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(receivers)), receivers)
    axes.set_yticks(range(len(givers)), givers)
    axes.set_xlabel("receiver")
    axes.set_ylabel("giver")
    for row, line in enumerate(rates):
        for column, rate in enumerate(line):
            color = "white" if rate > _DARK else "black"
            axes.text(column, row, f"{100 * rate:.0f} %", ha="center", va="center", color=color)
    axes.set_title(title, fontsize=8)
    figure.colorbar(picture, ax=axes, label="success")
    figure.tight_layout()
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
