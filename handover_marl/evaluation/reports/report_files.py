"""Reports of result folders: computed from the stored results, written beside them, and shown as web pages."""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.splits import SETUPS, list_split_scenes
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.episode_tables import FLUENCY_NOTE, SCENE_HEADER, format_scene_cells
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.statistics import compute_wilson_interval
from handover_marl.evaluation.reports.tables import REPORTED_STATUSES, format_interval
from handover_marl.evaluation.results.episode_file import read_episode_file
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD, ResultMetadata, read_result_metadata
from handover_marl.evaluation.results.result_folder import REPORT_FILES, find_replays, read_results
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS
from handover_marl.version import __version__
from handover_marl.visualization.web_page import render_page

# Data sets with the scene numbers of DexYCB.
_OFFICIAL_SCENES = ("dexycb", "synthetic")


def evaluate(folder: str | os.PathLike[str]) -> Report:
    """Compute the metrics of an official result folder, of this library or of HandoverSim, or of an episode file.

    Args:
        folder: Result folder, or a file of `docs/results/data/episodes`; nothing is changed.

    Raises:
        ResultsError: The path does not exist, or a file is not an official result.
    """
    try:
        path = Path(folder).expanduser()
        is_file, exists = path.is_file(), path.exists()
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise ResultsError(f"{folder!r} is no result folder ({error})") from error
    if not exists:
        raise ResultsError(f"result folder {path} does not exist")
    metadata, results = read_episode_file(path) if is_file else (read_result_metadata(path), read_results(path))
    setup, split = metadata.setup, metadata.split
    size = metadata.split_size
    if results[-1].index >= size:
        raise ResultsError(f"{path}: {results[-1].index:03d}.npz exceeds {setup} {split}, which has {size} scenes")
    # HandoverSim's code may count the step in which the time is up.
    longest = OFFICIAL_CONFIG.protocol.horizon_steps + 1
    for result in results if metadata.world == OFFICIAL_WORLD else ():
        if result.steps > longest:
            raise ResultsError(
                f"{path}: {result.index:03d}.npz must have at most {longest} steps by the official rules, got "
                f"{result.steps}; delete it and run the scene again"
            )
    return Report(metadata, tuple(_add_scene_info(path, metadata, results)), size)


def format_report_files(folder: Path, report: Report) -> dict[str, str]:
    """Return the contents of a report's files, by file name: JSON, Markdown, web page and CSV of the episodes.

    Args:
        folder: Result folder; the web page links to the replay pages in it.
        report: Report to format.
    """
    contents = (
        json.dumps(report.to_json(), indent=2, allow_nan=False) + "\n",
        report.to_markdown(),
        render_report_page(report, find_replay_links(folder, folder)),
        report.format_episodes_csv(),
    )
    return dict(zip(REPORT_FILES, contents, strict=True))


def write_report(folder: Path, report: Report) -> None:
    """Write a report's files into a result folder.

    Raises:
        ResultsError: The folder cannot be written.
    """
    for name, content in format_report_files(folder, report).items():
        write_atomically(folder / name, content)


def _add_scene_info(path: Path, metadata: ResultMetadata, results: Iterable[EpisodeResult]) -> Iterator[EpisodeResult]:
    """Add scene, object and subject to results of HandoverSim, if their index determines them.

    Raises:
        ResultsError: A result states another scene than its index.
    """
    # In s2 the index of a scene depends on the hand used; scenes of other data only their data set knows.
    if metadata.setup not in SETUPS or metadata.setup == "s2" or metadata.dataset not in _OFFICIAL_SCENES:
        yield from results
        return
    scenes = list_split_scenes(metadata.setup, metadata.split, lambda _: "")
    for result in results:
        scene_id = scenes[result.index]
        if result.scene_id is None:
            name, subject = CLASS_NAMES[SCENE_CLASSES[scene_id // 5 % 20]], SUBJECTS[scene_id // 100]
            yield replace(result, scene_id=scene_id, object_name=name, subject=subject)
        elif result.scene_id == scene_id:
            yield result
        else:
            raise ResultsError(
                f"{path}: {result.index:03d}.npz must be of scene {scene_id}, got scene {result.scene_id}; delete it, "
                "or give it its name back"
            )


def render_report_page(report: Report, replays: Mapping[int, str] | None = None) -> str:
    """Render a report as a self-contained web page.

    Args:
        report: Report to render.
        replays: Links to replay pages by scene number, relative to the page.
    """
    links = dict(replays or {})
    metadata = report.metadata
    official, objects, fluency = report.build_tables()
    return render_page(
        "report.html",
        version=__version__,
        title=f"{metadata.receiver} on {metadata.setup} {metadata.split}",
        heading=report.heading,
        kinds=[_group_episodes(report, flag) for flag in REPORTED_STATUSES],
        n_episodes=len(report.episodes),
        n_replays=sum(episode.scene_id in links for episode in report.episodes),
        official=official,
        notes=report.format_notes().splitlines(),
        settings=_list_settings(report),
        objects=objects,
        fluency=fluency,
        fluency_note=FLUENCY_NOTE,
        scene_header=SCENE_HEADER,
        outcome_column=SCENE_HEADER.index("outcome"),
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


def _group_episodes(report: Report, flag: EpisodeStatus) -> dict[str, Any]:
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
        "episodes": [(each, format_scene_cells(each)) for each in report.episodes if each.status & flag],
    }


def _list_settings(report: Report) -> list[tuple[str, str]]:
    stored = {key.replace("_", " "): value for key, value in asdict(report.metadata).items() if value}
    computed = {
        "data": report.data_label,
        "n episodes": report.extent,
        "machine": report.machine_label,
    }
    return list({**stored, **computed}.items())
