"""Tables of the episodes of one evaluation."""

from collections.abc import Iterable, Mapping, Sequence

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.tables import (
    COUNTS,
    EARLY_GRAB,
    FLUENCY,
    LATE,
    N_EPISODES,
    NO_VALUE,
    RATES,
    REPORTED_STATUSES,
    Estimate,
    ReportTable,
    estimate_mean,
    estimate_rate,
    format_percent_rate,
)
from handover_marl.evaluation.results import EpisodeResult

#: Titles of the cells of an episode: its keys in `report.json`.
SCENE_HEADER = ("scene id", "object name", "subject", "side", "outcome", "steps", "release step", "plan s")
# Further cells in evaluations with inference time.
_INFERENCE_HEADER = ("late s", "early grab")
FLUENCY_NOTE = (
    "Means over the n episodes that have a value. Human idle, robot idle, concurrent activity and functional delay are "
    "shares of the episode (Hoffman 2019); forces are sums of normal forces in one step of 1 ms; SPARC is spectral arc "
    "length; jerk is a root mean square. Definitions: docs/reference/metrics.md."
)


def count_status(episodes: Iterable[EpisodeResult], status: EpisodeStatus) -> int:
    """Count the episodes with a status flag."""
    return sum(bool(episode.status & status) for episode in episodes)


def get_scene_header(episodes: Iterable[EpisodeResult]) -> tuple[str, ...]:
    """Return the column titles of a table of episodes; with simulated inference time also those of its two metrics."""
    return SCENE_HEADER + (_INFERENCE_HEADER if any(episode.late_s is not None for episode in episodes) else ())


def format_scene_cells(episode: EpisodeResult) -> list[str]:
    """Return the cells of an episode as texts, in the order of `get_scene_header`; "-" for unknown values."""
    cells = (episode.scene_id, episode.object_name, episode.subject, episode.side, episode.status.label, episode.steps)
    texts = [NO_VALUE if cell is None else str(cell) for cell in (*cells, episode.release_step)]
    texts.append(f"{episode.plan_s:.3f}")
    if episode.late_s is not None:
        grab = {True: "yes", False: "no", None: NO_VALUE}[episode.early_grab]
        texts += [f"{episode.late_s:.3f}", grab]
    return texts


def build_scene_table(episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of outcomes with one row per scene."""
    return ReportTable(get_scene_header(episodes), [format_scene_cells(episode) for episode in episodes])


def build_object_table(episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of success rates and numbers of failures by object class."""
    rows = []
    for name in sorted({episode.object_name for episode in episodes if episode.object_name}):
        chosen = [episode for episode in episodes if episode.object_name == name]
        counts = [count_status(chosen, flag) for flag in REPORTED_STATUSES]
        rows.append([name, len(chosen), format_percent_rate(counts[0], len(chosen)), *counts[1:]])
    return ReportTable(["object name", *(column.title for column in (N_EPISODES, RATES[0], *COUNTS[1:]))], rows)


def estimate_fluency(episodes: Iterable[EpisodeResult]) -> dict[str, Estimate]:
    """Estimate the mean of every fluency metric, by key; empty if no episode has fluency metrics.

    If inference took simulated time, the time that passed and the rate of early grabs are included.
    """
    episodes = tuple(episodes)
    known = [episode.fluency for episode in episodes if episode.fluency is not None]
    means = {
        column.key: estimate_mean([float(value) for each in known if (value := getattr(each, column.key)) is not None])
        for column in (FLUENCY if known else ())
    }
    late = [episode.late_s for episode in episodes if episode.late_s is not None]
    grabs = [episode.early_grab for episode in episodes if episode.early_grab is not None]
    if late:
        means[LATE.key] = estimate_mean(late)
        means[EARLY_GRAB.key] = estimate_rate(sum(grabs), len(grabs)) if grabs else estimate_mean([])
    return means


def build_fluency_table(means: Mapping[str, Estimate], title: str = "mean") -> ReportTable:
    """Build the table of means by key, as `estimate_fluency` returns them; it has no rows if there are no means."""
    rows: list[list[object]] = []
    for column in (column for column in (*FLUENCY, LATE, EARLY_GRAB) if column.key in means):
        found = means[column.key]
        # Three digits, without exponents.
        sizes = [column.scale * abs(value) for value in (found.mean or 0.0, *(found.interval_95 or ()))]
        spec = ".0f" if max(sizes) >= 999.5 else ".4f" if any(0.0 < size < 1e-4 for size in sizes) else ".3g"
        cell = NO_VALUE if found.mean is None else f"{column.scale * found.mean:{spec}}"
        rows.append([column.title, cell, found.format_interval(spec, column.scale), found.n])
    return ReportTable(["metric", title, "95 % interval", "n"], rows)
