"""Learning curves: their points, and their pictures."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.statistics import wilson_interval
from handover_marl.protocol.status import EpisodeStatus


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation during training.

    Attributes:
        steps: Decisions that the learner has made so far.
        seconds: Wall-clock time so far, earlier evaluations counted (s).
        episodes: Scenes played.
        success: Share of them that succeeded (0..1); likewise the others.
        low: Lower end of Wilson's 95 % interval of `success`.
        high: Its upper end.
        contact: Robot touched person.
        drop: Object fell.
        timeout: 13 s without success.
        dataset: What was played; likewise
        physics: and
        partner: with whom.
    """

    steps: int
    seconds: float
    episodes: int
    success: float
    low: float
    high: float
    contact: float
    drop: float
    timeout: float
    dataset: str
    physics: str
    partner: str

    def told(self) -> str:
        """In a line, with all that a number needs beside it."""
        return (
            f"{self.steps} decisions, {self.seconds / 60.0:.1f} min: success {self.success:.1%} ({self.low:.1%} to "
            f"{self.high:.1%}), contact {self.contact:.1%}, drop {self.drop:.1%}, timeout {self.timeout:.1%} "
            f"[{self.episodes} scenes of {self.dataset}, {self.physics} physics, with {self.partner}]"
        )

    @classmethod
    def of(cls, report: Report, steps: int, seconds: float, partner: str) -> "CurvePoint":
        """From a report."""
        n = len(report.episodes)
        low, high = wilson_interval(report.count(EpisodeStatus.SUCCESS), n)
        return cls(
            steps=steps,
            seconds=seconds,
            episodes=n,
            success=report.success_rate,
            low=low,
            high=high,
            contact=report.contact_rate,
            drop=report.drop_rate,
            timeout=report.timeout_rate,
            dataset=report.settings.dataset,
            physics=report.settings.physics,
            partner=partner,
        )


def draw_curve(points: Sequence[CurvePoint]) -> bytes:
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
