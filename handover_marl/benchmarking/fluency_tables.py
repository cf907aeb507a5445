"""Metrics beyond the official ones, averaged over episodes."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.statistics import mean_interval
from handover_marl.episode.fluency import Fluency


@dataclass(frozen=True)
class FluencyMetric:
    """How a metric is shown.

    Attributes:
        key: Its name in `Fluency`.
        title: Its name in tables.
        unit: Unit in tables.
        scale: What the value is multiplied with to be in that unit.
    """

    key: str
    title: str
    unit: str
    scale: float = 1.0


METRICS = (
    FluencyMetric("handover_time", "time to handover", "s"),
    FluencyMetric("human_idle", "human idle", "%", 100.0),
    FluencyMetric("robot_idle", "robot idle", "%", 100.0),
    FluencyMetric("concurrent", "both active", "%", 100.0),
    FluencyMetric("functional_delay", "functional delay", "%", 100.0),
    FluencyMetric("peak_force", "peak force", "N"),
    FluencyMetric("min_distance", "closest", "cm", 100.0),
    FluencyMetric("giver_path", "hand path", "m"),
    FluencyMetric("giver_smoothness", "hand smoothness", "SPARC"),
    FluencyMetric("reach", "reach", "m"),
)
FLUENCY_NOTE = (
    "Means over the episodes that have a value. Idle, both active and functional delay are shares of the episode "
    "(Hoffman 2019); SPARC is spectral arc length; definitions: handover_marl.episode.fluency."
)


@dataclass(frozen=True)
class Average:
    """Mean of a metric.

    Attributes:
        mean: Over the episodes that have a value; None if none has.
        interval: Bootstrap 95 % interval, or None for fewer than two.
        n: Episodes that have a value.
    """

    mean: float | None
    interval: tuple[float, float] | None
    n: int


def fluency_averages(episodes: Sequence[EpisodeResult]) -> dict[str, Average]:
    """The mean of every metric by its name in `Fluency`; nothing if no episode has metrics."""
    known = [episode.fluency for episode in episodes if episode.fluency is not None]
    return {part.name: _average(known, part.name) for part in fields(Fluency)} if known else {}


def fluency_row(episodes: Sequence[EpisodeResult]) -> list[str]:
    """A cell for each of `METRICS`: mean and interval in the metric's unit."""
    averages = fluency_averages(episodes)
    return [_cell(averages.get(metric.key), metric.scale) for metric in METRICS]


def fluency_header() -> list[str]:
    """Titles of `METRICS` with units."""
    return [f"{metric.title} {metric.unit}" for metric in METRICS]


def _average(known: Sequence[Fluency], name: str) -> Average:
    values = [float(value) for fluency in known if (value := getattr(fluency, name)) is not None]
    return Average(float(np.mean(values)) if values else None, mean_interval(values), len(values))


def _cell(average: Average | None, scale: float) -> str:
    if average is None or average.mean is None:
        return "-"
    if average.interval is None:
        return f"{scale * average.mean:.3g}"
    low, high = average.interval
    return f"{scale * average.mean:.3g} ({scale * low:.3g} to {scale * high:.3g})"
