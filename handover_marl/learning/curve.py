"""Learning curves as pictures."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from handover_marl.learning.training import CurvePoint


def draw_curve(points: Sequence["CurvePoint"]) -> bytes:
    """Outcome rates over training time, with Wilson's 95 % interval of success, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    minutes = [point.seconds / 60.0 for point in points]
    success = axes.plot(minutes, [100.0 * point.success for point in points], marker="o", ms=3, label="success")
    color = success[0].get_color()
    lows, highs = ([100.0 * getattr(point, end) for point in points] for end in ("low", "high"))
    axes.fill_between(minutes, lows, highs, color=color, alpha=0.15, linewidth=0.0)
    for name, style in (("contact", "--"), ("drop", ":"), ("timeout", "-.")):
        axes.plot(minutes, [100.0 * getattr(point, name) for point in points], style, linewidth=1.0, label=name)
    last = points[-1]
    axes.set_title(
        f"{last.episodes} scenes of {last.dataset}, {last.physics} physics, with {last.partner}; "
        f"{last.steps} decisions",
        fontsize=9,
    )
    axes.set_xlabel("wall-clock time, evaluations counted (min)")
    axes.set_ylabel("episodes (%); band: 95 % interval")
    axes.set_ylim(0.0, 100.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=120)
    return stream.getvalue()
