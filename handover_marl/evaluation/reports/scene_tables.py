"""Tables with one row per scene or per object class, and the CSV file of all episodes."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

from handover_marl.evaluation.reports.columns import COUNTS, FLUENCY, N_EPISODES, RATES, REPORTED_STATUSES
from handover_marl.evaluation.reports.tables import NO_VALUE, ReportTable, format_csv, format_percent_rate
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata

#: Titles of the cells of an episode: its keys in `report.json`.
SCENE_HEADER = ("scene id", "object name", "subject", "side", "outcome", "steps", "release step", "plan s")

# Fields of an evaluation with which each row of the CSV file starts.
_IDENTITY = ("receiver", "giver", "setup", "split", "dataset", "physics", "seed", "version")


def describe_episode(episode: EpisodeResult) -> dict[str, Any]:
    """Return the values of an episode as JSON types, by key; metrics are in the dictionary `fluency`."""
    return {**asdict(episode), "status": int(episode.status), "outcome": episode.status.label}


def format_episodes_csv(metadata: ResultMetadata, episodes: Sequence[EpisodeResult]) -> str:
    """Return CSV text with one row per episode, under the keys of `report.json`.

    Every row starts with the identity of the evaluation. Numbers have full precision, in the units
    of `report.json`; missing values are empty.
    """
    identity = {key: getattr(metadata, key) for key in _IDENTITY}
    rows: list[dict[str, Any]] = []
    for episode in episodes:
        values = describe_episode(episode)
        fluency = values.pop("fluency") or {column.key: None for column in FLUENCY}
        rows.append({**identity, **values, **fluency})
    return format_csv([list(rows[0]), *(list(row.values()) for row in rows)])


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
