"""Means and table cells of the fluency metrics (`FluencyMetrics`), which are not official."""

from collections.abc import Iterable, Mapping, Sequence

from handover_marl.evaluation.reports.columns import FLUENCY
from handover_marl.evaluation.reports.statistics import MeanEstimate, estimate_mean
from handover_marl.evaluation.reports.tables import NO_VALUE, ReportTable, format_interval
from handover_marl.evaluation.results.episode_result import EpisodeResult

_KEYS = tuple(column.key for column in FLUENCY)
FLUENCY_NOTE = (
    "Means over the n episodes that have a value. Human idle, robot idle, concurrent activity and functional delay are "
    "shares of the episode (Hoffman 2019); forces are sums of normal forces in one step of 1 ms; SPARC is spectral arc "
    "length; jerk is a root mean square. Definitions: docs/reference/rules_and_metrics.md."
)


def estimate_fluency(episodes: Sequence[EpisodeResult]) -> dict[str, MeanEstimate]:
    """Estimate the mean of every fluency metric, by key; empty if no episode has fluency metrics."""
    known = [episode.fluency for episode in episodes if episode.fluency is not None]
    return {
        column.key: estimate_mean([float(value) for each in known if (value := getattr(each, column.key)) is not None])
        for column in (FLUENCY if known else ())
    }


def build_fluency_table(episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of fluency metrics; without rows if no episode has fluency metrics."""
    return ReportTable(["metric", "mean", "95 % interval", "n"], _format_rows(estimate_fluency(episodes)))


def build_fluency_difference_table(
    pairs: Iterable[tuple[EpisodeResult, EpisodeResult]], names: tuple[str, str]
) -> ReportTable:
    """Build the table of mean differences of fluency metrics; without rows if no pair has fluency metrics.

    Args:
        pairs: Results of the same scenes in two evaluations. A metric is compared on the scenes where both have it.
        names: Names of the evaluations; the second one is subtracted from the first.
    """
    known = [(one.fluency, other.fluency) for one, other in pairs if one.fluency and other.fluency]
    values = {key: [(getattr(one, key), getattr(other, key)) for one, other in known] for key in _KEYS}
    means = {
        key: estimate_mean([float(one - other) for one, other in both if one is not None and other is not None])
        for key, both in values.items()
    }
    header = ["metric", f"{names[0]} minus {names[1]}", "95 % interval", "n"]
    return ReportTable(header, _format_rows(means if known else {}))


def _format_rows(means: Mapping[str, MeanEstimate]) -> list[list[object]]:
    """Format the title, mean, interval and number of values of each metric, by key."""
    rows: list[list[object]] = []
    for column in FLUENCY if means else ():
        mean, interval = means[column.key].mean, means[column.key].interval_95
        if mean is None:
            rows.append([column.title, NO_VALUE, NO_VALUE, 0])
            continue
        # Three digits, without exponents.
        sizes = [column.scale * abs(value) for value in (mean, *(interval or ()))]
        spec = ".0f" if max(sizes) >= 999.5 else ".4f" if any(0.0 < size < 1e-4 for size in sizes) else ".3g"
        cells = [f"{column.scale * mean:{spec}}", format_interval(interval, spec, column.scale)]
        rows.append([column.title, *cells, means[column.key].n])
    return rows


def format_fluency_row(episodes: Sequence[EpisodeResult]) -> list[str]:
    """Format a table cell for each fluency metric: its mean, interval and number of episodes."""
    rows = build_fluency_table(episodes).rows
    return [_format_cell(*row[1:]) for row in rows] or [NO_VALUE] * len(FLUENCY)


def _format_cell(mean: object, interval: object, n: object) -> str:
    inside = f"n {n}" if interval == NO_VALUE else f"{interval}; n {n}"
    return f"{mean} ({inside})" if n else NO_VALUE


def format_fluency_header() -> list[str]:
    """Return the column titles of the fluency metrics, with units."""
    return [column.title for column in FLUENCY]
