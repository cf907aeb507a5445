"""Web pages of reports, with links to the replay pages of their episodes."""

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from handover_marl import __version__
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.columns import REPORTED_STATUSES
from handover_marl.evaluation.reports.fluency_tables import FLUENCY_NOTE
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.scene_tables import build_scene_table
from handover_marl.evaluation.reports.statistics import compute_wilson_interval
from handover_marl.evaluation.reports.tables import format_interval
from handover_marl.evaluation.results.result_folder import find_replays
from handover_marl.visualization.web_page import render_page

_OUTCOME_COLUMN = "outcome"


def render_report_page(report: Report, replays: Mapping[int, str] | None = None) -> str:
    """Render a report as a self-contained web page.

    Args:
        report: Report to render.
        replays: Links to replay pages by scene number, relative to the page.
    """
    links = dict(replays or {})
    scenes = build_scene_table(report.episodes)
    metadata = report.metadata
    official, objects, fluency = report.build_tables()
    return render_page(
        "report.html",
        version=__version__,
        title=f"{metadata.receiver} on {metadata.setup} {metadata.split}",
        heading=report.heading,
        kinds=[_group_episodes(report, flag, scenes.rows) for flag in REPORTED_STATUSES],
        n_episodes=len(report.episodes),
        n_replays=sum(episode.scene_id in links for episode in report.episodes),
        official=official,
        notes=report.format_notes().splitlines(),
        settings=_list_settings(report),
        objects=objects,
        fluency=fluency,
        fluency_note=FLUENCY_NOTE,
        scene_header=scenes.header,
        outcome_column=list(scenes.header).index(_OUTCOME_COLUMN),
        replays=links,
    )


def find_replay_links(results: Path, page_folder: Path) -> dict[int, str]:
    """Find the replay pages of a result folder, as links relative to a page.

    Args:
        results: Result folder whose replay pages are searched.
        page_folder: Folder of the page that links to them.

    Returns:
        Relative links by scene number.
    """
    relative = os.path.relpath(results.resolve(), page_folder.resolve())
    replays = find_replays(results).items()
    return {scene: Path(relative, path.relative_to(results)).as_posix() for scene, path in replays}


def _group_episodes(report: Report, flag: EpisodeStatus, rows: Any) -> dict[str, Any]:
    """Return count, rate (%) and episodes with a status flag, for the page's template."""
    n, count = len(report.episodes), report.count(flag)
    interval = compute_wilson_interval(count, n)
    low, high = (100 * end for end in interval)
    return {
        "label": flag.label,
        "count": count,
        "percent": f"{100 * count / n:.1f}",
        "interval": format_interval(interval),
        "low": f"{low:.2f}",
        "width": f"{high - low:.2f}",
        "episodes": [pair for pair in zip(report.episodes, rows, strict=True) if pair[0].status & flag],
    }


def _list_settings(report: Report) -> list[tuple[str, str]]:
    stored = {key.replace("_", " "): value for key, value in asdict(report.metadata).items() if value}
    computed = {
        "data": report.data_label,
        "n episodes": report.extent,
        "machine": report.machine_label,
    }
    return list({**stored, **computed}.items())
