"""Official metrics of an evaluation, and their table beside published results."""

from collections.abc import Sequence

from handover_marl.config import TIME_STEP
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.columns import AVERAGE_SUCCESS, RATES, REPORTED_STATUSES, TIMES, WAIT
from handover_marl.evaluation.reports.published import PUBLISHED, PublishedResult
from handover_marl.evaluation.reports.statistics import MeanEstimate, estimate_mean
from handover_marl.evaluation.reports.tables import (
    NO_VALUE,
    ReportTable,
    format_interval,
    format_percent_interval,
    format_seconds,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD, ResultMetadata


def count_status(episodes: Sequence[EpisodeResult], status: EpisodeStatus) -> int:
    """Count the episodes with a status flag."""
    return sum(bool(episode.status & status) for episode in episodes)


def estimate_official_means(episodes: Sequence[EpisodeResult]) -> dict[str, MeanEstimate]:
    """Estimate average success over all episodes and the times (s) over successes, by key."""
    successes = [episode for episode in episodes if episode.success]
    times = [(episode.steps * TIME_STEP, episode.plan_s) for episode in successes]
    values = [[exec_s for exec_s, _ in times], [plan_s for _, plan_s in times], [sum(pair) for pair in times]]
    return {
        AVERAGE_SUCCESS.key: estimate_mean([episode.speed_score for episode in episodes]),
        **{column.key: estimate_mean(part) for column, part in zip(TIMES, values, strict=True)},
    }


def build_official_table(metadata: ResultMetadata, episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of official metrics with 95 % intervals, and of published results."""
    n, means = len(episodes), estimate_official_means(episodes)
    score, times = means[AVERAGE_SUCCESS.key], [means[column.key] for column in TIMES]
    counts = [count_status(episodes, flag) for flag in REPORTED_STATUSES]
    rates = [f"{100 * count / n:.2f} ({count}/{n})" for count in counts]
    rate_intervals = [format_percent_interval(count, n) for count in counts]
    # The interval of the total would not fit into the width.
    time_intervals = [*(format_interval(each.interval_95, ".3f", 1.0) for each in times[:-1]), NO_VALUE]
    rows: list[list[object]] = [
        [
            metadata.receiver,
            *rates,
            f"{100 * (score.mean or 0.0):.2f}",
            metadata.wait_s or NO_VALUE,
            *(format_seconds(each.mean) for each in times),
        ],
        ["95 % interval", *rate_intervals, format_interval(score.interval_95), NO_VALUE, *time_intervals],
        ["n", *[n] * len(RATES), score.n, NO_VALUE, *(each.n for each in times)],
        *(_format_published_row(row) for row in find_comparable_rows(metadata)),
    ]
    header = ["receiver", *(column.title for column in (*RATES, AVERAGE_SUCCESS, WAIT, *TIMES))]
    return ReportTable(header, rows, split_column=header.index(AVERAGE_SUCCESS.title))


def find_comparable_rows(metadata: ResultMetadata) -> tuple[PublishedResult, ...]:
    """Return the published results that were measured with the scenes, physics and rules of an evaluation."""
    identity = (metadata.split, metadata.dataset, metadata.physics, metadata.world)
    return PUBLISHED.get(metadata.setup, ()) if identity == ("test", "dexycb", "exact", OFFICIAL_WORLD) else ()


def _format_published_row(row: PublishedResult) -> list[object]:
    rates = [f"{rate:.2f}" for rate in (row.success, row.contact, row.drop, row.timeout)]
    times = [format_seconds(value) for value in (row.time_exec, row.time_plan, row.time_total)]
    return [f"published: {row.method}", *rates, f"{row.average_success:.2f}*", f"{row.wait_s:g}", *times]
