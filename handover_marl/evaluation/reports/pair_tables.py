"""Tables that compare two evaluations of the same scenes."""

from collections.abc import Iterable, Sequence

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.columns import AVERAGE_SUCCESS, N_EPISODES, REPORTED_STATUSES
from handover_marl.evaluation.reports.scene_tables import SCENE_HEADER, format_scene_cells
from handover_marl.evaluation.reports.statistics import compute_paired_difference
from handover_marl.evaluation.reports.tables import (
    ReportTable,
    format_percent_difference,
    format_percent_mean,
    format_percent_rate,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult

EpisodePair = tuple[EpisodeResult, EpisodeResult]
# Cells of a scene that identify it, and those of its outcome.
_SCENE, _OUTCOME = slice(0, 2), slice(4, 7)


def compute_rate_difference(
    first: Iterable[EpisodeResult], second: Iterable[EpisodeResult], flag: EpisodeStatus
) -> tuple[float, float, float]:
    """Compute the difference of an outcome's rates in two evaluations of the same scenes.

    Args:
        first: Results whose rate is the minuend.
        second: Results of the same scenes, whose rate is subtracted.
        flag: Outcome whose rates are compared, e.g. success.

    Returns:
        Difference, lower and upper end of its 95 % interval (-1..1).
    """
    flags = ([bool(episode.status & flag) for episode in episodes] for episodes in (first, second))
    return compute_paired_difference(*flags)


def build_rate_table(pairs: Sequence[EpisodePair], names: tuple[str, str]) -> ReportTable:
    """Build the table of outcome rates and AS of two evaluations and of their differences.

    Args:
        pairs: Results of the same scenes in both evaluations.
        names: Names of the evaluations; the second one is subtracted from the first.
    """
    n, rows = len(pairs), []
    sides = list(zip(*pairs, strict=True))
    for flag in REPORTED_STATUSES:
        cells = [format_percent_rate(sum(bool(each.status & flag) for each in side), n, digits=2) for side in sides]
        difference = compute_rate_difference(sides[0], sides[1], flag)
        rows.append([flag.label, *cells, format_percent_difference(difference, digits=2), n])
    scores = [[result.speed_score for result in side] for side in sides]
    gains = [first - second for first, second in zip(*scores, strict=True)]
    means = [*map(format_percent_mean, scores), format_percent_mean(gains, signed=True)]
    rows.append([AVERAGE_SUCCESS.key, *means, n])
    first, second = names
    return ReportTable(
        ["metric", f"{first} %", f"{second} %", f"{first} minus {second}, points", N_EPISODES.title], rows
    )


def build_difference_table(pairs: Iterable[EpisodePair], names: tuple[str, str]) -> ReportTable:
    """Build the table of scenes with different outcomes.

    Args:
        pairs: Results of the same scenes in two evaluations.
        names: Names of the evaluations.
    """
    rows = []
    for pair in pairs:
        if pair[0].status != pair[1].status:
            first, second = (format_scene_cells(result) for result in pair)
            outcomes = zip(first[_OUTCOME], second[_OUTCOME], strict=True)
            rows.append([*first[_SCENE], *(cell for cells in outcomes for cell in cells)])
    titles = [f"{name} {title}" for title in SCENE_HEADER[_OUTCOME] for name in names]
    return ReportTable([*SCENE_HEADER[_SCENE], *titles], rows, split_column=6, n_keys=2)
