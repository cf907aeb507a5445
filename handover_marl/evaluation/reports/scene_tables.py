"""Tables with one row per scene or per object class."""

from collections.abc import Iterable, Sequence

from handover_marl.evaluation.reports.columns import COUNTS, N_EPISODES, RATES, REPORTED_STATUSES
from handover_marl.evaluation.reports.tables import NO_VALUE, ReportTable, format_percent_rate
from handover_marl.evaluation.results.episode_result import EpisodeResult

#: Titles of the cells of an episode: its keys in `report.json`.
SCENE_HEADER = ("scene id", "object name", "subject", "side", "outcome", "steps", "release step", "plan s")


def build_scene_table(episodes: Iterable[EpisodeResult]) -> ReportTable:
    """Build the table of outcomes with one row per scene."""
    return ReportTable(SCENE_HEADER, [format_scene_cells(episode) for episode in episodes])


def format_scene_cells(episode: EpisodeResult) -> list[str]:
    """Format the cells of an episode, in the order of `SCENE_HEADER`."""
    known = (episode.scene_id, episode.object_name, episode.subject, episode.side, episode.status.label)
    release_step = NO_VALUE if episode.release_step is None else str(episode.release_step)
    texts = [NO_VALUE if cell is None else str(cell) for cell in known]
    return [*texts, str(episode.steps), release_step, f"{episode.plan_s:.3f}"]


def build_object_table(episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of outcomes by object class."""
    rows = []
    for name in sorted({episode.object_name for episode in episodes if episode.object_name}):
        chosen = [episode for episode in episodes if episode.object_name == name]
        counts = [sum(bool(episode.status & flag) for episode in chosen) for flag in REPORTED_STATUSES]
        rows.append([name, len(chosen), format_percent_rate(counts[0], len(chosen)), *counts[1:]])
    return ReportTable(["object name", *(column.title for column in (N_EPISODES, RATES[0], *COUNTS[1:]))], rows)
