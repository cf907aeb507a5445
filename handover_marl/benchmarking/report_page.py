"""Reports and comparisons as web pages, with links to the replays that are there."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from handover_marl._version import __version__
from handover_marl.benchmarking.comparison import Comparison
from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.fluency_tables import FLUENCY_NOTE
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import replay_paths
from handover_marl.benchmarking.statistics import wilson_interval
from handover_marl.benchmarking.tables import (
    RATES,
    fluency_table,
    heading,
    notes,
    object_table,
    official_table,
    percent_interval,
    report_extent,
    scene_table,
)
from handover_marl.pages.page import page
from handover_marl.protocol.status import EpisodeStatus

_TITLES = {
    "receiver_code": "receiver's code",
    "giver_code": "giver's code",
    "world": "world and rules",
    "wait": "wait (s)",
}
_OUTCOME = "outcome"


@dataclass(frozen=True)
class _Kind:
    """The episodes of one outcome; numbers are percents."""

    label: str
    count: int
    percent: str
    interval: str
    low: str
    width: str
    episodes: list[tuple[EpisodeResult, list[object]]]


def report_page(report: Report, replays: Mapping[int, str] | None = None) -> str:
    """A report as a page that loads nothing: success and failures with intervals, settings, objects, every scene.

    Args:
        report: The report.
        replays: Links to replays by scene, from where the page will be.
    """
    links = dict(replays or {})
    scenes = scene_table(report.episodes)
    fluency = fluency_table(report)
    settings = report.settings
    return page(
        "report.html",
        version=__version__,
        title=f"{settings.receiver} on {settings.setup} {settings.split}",
        heading=heading(report),
        kinds=[_kind(report, flag, scenes.rows) for flag in RATES],
        n_episodes=len(report.episodes),
        n_replays=sum(episode.scene_id in links for episode in report.episodes),
        official=official_table(report),
        notes=notes(report).splitlines(),
        settings=_settings(report),
        objects=object_table(report),
        fluency=fluency,
        fluency_note=FLUENCY_NOTE,
        scene_header=scenes.header,
        outcome_column=list(scenes.header).index(_OUTCOME),
        replays=links,
    )


def comparison_page(comparison: Comparison, replays: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {})) -> str:
    """A comparison as a page that loads nothing.

    Args:
        comparison: The comparison.
        replays: Links to replays of either side by scene, from where the page will be.
    """
    names = [report.settings.receiver for report in (comparison.first, comparison.second)]
    return page(
        "comparison.html",
        version=__version__,
        title=f"{names[0]} (A) beside {names[1]} (B)",
        sides=[("A", heading(comparison.first)), ("B", heading(comparison.second))],
        rates=comparison.rates(),
        note=comparison.note(),
        changes=comparison.changes(),
        replays=replays,
    )


def replay_links(results: Path, page_folder: Path) -> dict[int, str]:
    """Links to the replays of a result folder by scene, for a page in some folder."""
    there = os.path.relpath(results.resolve(), page_folder.resolve())
    return {scene: Path(there, path.relative_to(results)).as_posix() for scene, path in replay_paths(results).items()}


def _kind(report: Report, flag: EpisodeStatus, rows: Any) -> _Kind:
    n, count = len(report.episodes), report.count(flag)
    low, high = (100 * end for end in wilson_interval(count, n))
    return _Kind(
        flag.label,
        count,
        f"{100 * count / n:.1f}",
        percent_interval(count, n),
        f"{low:.2f}",
        f"{high - low:.2f}",
        [(episode, row) for episode, row in zip(report.episodes, rows, strict=True) if episode.status & flag],
    )


def _settings(report: Report) -> list[tuple[str, str]]:
    told = {_TITLES.get(key, key): value for key, value in asdict(report.settings).items() if value}
    more = {"data": report.data_label(), "scenes": report_extent(report), "planning timed on": report.machine_label()}
    return list({**told, **more}.items())
