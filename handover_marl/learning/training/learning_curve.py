"""Points and plot of a learning curve."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.statistics import compute_wilson_interval

#: Units of the steps of learning curves.
DECISIONS, UPDATES = "decisions", "gradient updates"


@dataclass(frozen=True)
class CurvePoint:
    """Point of a learning curve: one evaluation during training.

    Attributes:
        steps: Number of decisions of the learning agents before the evaluation; in the training of networks by
            imitation (`train_vision.py`, `train_gaddpg.py`), number of gradient updates.
        seconds: Wall-clock time since the start of training, evaluations included (s).
        episodes: Number of evaluated scenes.
        success: Share of scenes with success, from 0 to 1.
        low: Lower end of Wilson's 95 % interval of `success`.
        high: Upper end of Wilson's 95 % interval of `success`.
        contact: Share of scenes in which the robot touched the person.
        drop: Share of scenes in which the object fell.
        timeout: Share of scenes without success within the time limit.
        dataset: Dataset of the scenes.
        physics: Physics of the evaluation.
        partner: Policy of the other agent.
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

    def summarize(self, unit: str) -> str:
        """Return the step count, in a unit such as "decisions", and outcome rates as one line of text."""
        return (
            f"{self.steps} {unit}, {self.seconds / 60.0:.1f} min: success {self.success:.1%} ({self.low:.1%} to "
            f"{self.high:.1%}), contact {self.contact:.1%}, drop {self.drop:.1%}, timeout {self.timeout:.1%} "
            f"[{self.episodes} scenes of {self.dataset}, {self.physics} physics, with {self.partner}]"
        )

    @classmethod
    def from_report(cls, report: Report, steps: int, seconds: float, partner: str) -> "CurvePoint":
        """Create a point from the report of an evaluation."""
        n = len(report.episodes)
        low, high = compute_wilson_interval(report.count(EpisodeStatus.SUCCESS), n)
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
            dataset=report.metadata.dataset,
            physics=report.metadata.physics,
            partner=partner,
        )


def draw_curve(points: Sequence[CurvePoint], unit: str) -> bytes:
    """Return a PNG of outcome rates over wall-clock time, with Wilson's 95 % interval of success.

    Args:
        points: Points of the curve.
        unit: Unit of their `steps`: "decisions" or "gradient updates".
    """
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
        f"{last.episodes} scenes of {last.dataset}, {last.physics} physics, with {last.partner}; {last.steps} {unit}",
        fontsize=9,
    )
    axes.set_xlabel("wall-clock time, evaluations included (min)")
    axes.set_ylabel("episodes (%); band: 95 % interval")
    axes.set_ylim(0.0, 100.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=120)
    return stream.getvalue()
