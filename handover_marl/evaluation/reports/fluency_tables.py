"""Means and table cells of the fluency metrics (`FluencyMetrics`), which are not official."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from handover_marl.episode.metrics import FluencyMetrics
from handover_marl.evaluation.reports.statistics import compute_mean_interval
from handover_marl.evaluation.reports.tables import NO_VALUE, append_interval
from handover_marl.evaluation.results.episode_result import EpisodeResult

#: Unit in tables of each metric, and factor from the unit of `FluencyMetrics`.
FLUENCY_UNITS = {
    "handover_time": ("s", 1.0),
    "human_idle": ("%", 100.0),
    "robot_idle": ("%", 100.0),
    "concurrent": ("%", 100.0),
    "functional_delay": ("%", 100.0),
    "peak_force": ("N", 1.0),
    "min_distance": ("cm", 100.0),
    "giver_path": ("m", 1.0),
    "giver_smoothness": ("SPARC", 1.0),
    "reach": ("m", 1.0),
}
FLUENCY_NOTE = (
    "Means over the episodes that have a value. Human idle, robot idle, concurrent activity and functional delay are "
    "shares of the episode (Hoffman 2019); SPARC is spectral arc length; definitions: handover_marl.episode.metrics."
)


@dataclass(frozen=True)
class MetricMean:
    """Mean of a metric over episodes, with its confidence interval.

    Attributes:
        mean: Mean over the episodes that have a value; None if none has.
        interval: Bootstrap 95 % interval, or None for fewer than two values.
        n: Number of episodes that have a value.
    """

    mean: float | None
    interval: tuple[float, float] | None
    n: int


def compute_fluency_means(episodes: Sequence[EpisodeResult]) -> dict[str, MetricMean]:
    """Compute the mean of every fluency metric by name; empty if no episode has fluency metrics."""
    known = [episode.fluency for episode in episodes if episode.fluency is not None]
    means = {}
    for field in fields(FluencyMetrics) if known else ():
        values = [float(value) for metrics in known if (value := getattr(metrics, field.name)) is not None]
        mean = float(np.mean(values)) if values else None
        means[field.name] = MetricMean(mean, compute_mean_interval(values), len(values))
    return means


def format_fluency_row(episodes: Sequence[EpisodeResult]) -> list[str]:
    """Format a table cell for each fluency metric: its mean and interval."""
    means = compute_fluency_means(episodes)
    return [_format_mean(means.get(key), scale) for key, (_, scale) in FLUENCY_UNITS.items()]


def format_fluency_header() -> list[str]:
    """Return the column titles of the fluency metrics, with units."""
    return [f"{key.replace('_', ' ')} {unit}" for key, (unit, _) in FLUENCY_UNITS.items()]


def _format_mean(mean: MetricMean | None, scale: float) -> str:
    if mean is None or mean.mean is None:
        return NO_VALUE
    return append_interval(f"{scale * mean.mean:.3g}", mean.interval, ".3g", scale)
