"""Cross-play as a picture."""

import io
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

if TYPE_CHECKING:
    from handover_marl.benchmarking.crossplay import CrossPlay

# Cells darker than this share of success carry white letters.
_DARK = 0.55


def heat_map(crossplay: "CrossPlay") -> bytes:
    """A PNG of the success rates, givers down, receivers across."""
    rates = crossplay.success_rates()
    report = next(iter(crossplay.reports.values()))
    settings, n = report.settings, len(report.episodes)
    figure = Figure(figsize=(2.6 + 1.3 * len(crossplay.receivers), 1.9 + 0.55 * len(crossplay.givers)), dpi=150)
    axes = figure.add_subplot()
    picture = axes.imshow(rates, cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(crossplay.receivers)), crossplay.receivers)
    axes.set_yticks(range(len(crossplay.givers)), crossplay.givers)
    axes.set_xlabel("receiver")
    axes.set_ylabel("giver")
    for row, line in enumerate(rates):
        for column, rate in enumerate(line):
            color = "white" if rate > _DARK else "black"
            axes.text(column, row, f"{100 * rate:.0f} %", ha="center", va="center", color=color)
    title = f"{settings.setup} {settings.split}, {n} episodes a cell\n{report.data_label()}"
    title += f", {settings.physics} physics"
    axes.set_title(title, fontsize=8)
    figure.colorbar(picture, ax=axes, label="success")
    figure.tight_layout()
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
