"""Reports of result folders: computed from the stored results, and written beside them."""

import json
import os
from dataclasses import replace
from pathlib import Path

from handover_marl.datasets.splits import SETUPS, list_split_scenes
from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.pages import find_replay_links, render_report_page
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.scene_tables import format_episodes_csv
from handover_marl.evaluation.results.episode_file import read_episode_file
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata, read_result_metadata
from handover_marl.evaluation.results.result_folder import REPORT_FILES, read_results
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS

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
    scenes = _list_known_scenes(metadata)
    return Report(metadata, tuple(_add_scene_info(path, result, scenes) for result in results), size)


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
        format_episodes_csv(report.metadata, report.episodes),
    )
    return dict(zip(REPORT_FILES, contents, strict=True))


def write_report(folder: Path, report: Report) -> None:
    """Write a report's files into a result folder.

    Raises:
        ResultsError: The folder cannot be written.
    """
    for name, content in format_report_files(folder, report).items():
        write_atomically(folder / name, content)


def _list_known_scenes(metadata: ResultMetadata) -> tuple[int, ...] | None:
    """Return the scene number of every index of a split, or None if only the data set knows them."""
    # In s2 the index of a scene depends on the hand used.
    if metadata.setup == "s2" or metadata.setup not in SETUPS or metadata.dataset not in _OFFICIAL_SCENES:
        return None
    return list_split_scenes(metadata.setup, metadata.split, lambda _: "")


def _add_scene_info(path: Path, result: EpisodeResult, scenes: tuple[int, ...] | None) -> EpisodeResult:
    """Add scene, object and subject to a result of HandoverSim, if the index determines them.

    Raises:
        ResultsError: A result states another scene than its index.
    """
    if scenes is None:
        return result
    scene_id = scenes[result.index]
    if result.scene_id is not None:
        if result.scene_id != scene_id:
            raise ResultsError(
                f"{path}: {result.index:03d}.npz must be of scene {scene_id}, got scene {result.scene_id}; delete it, "
                "or give it its name back"
            )
        return result
    return replace(
        result,
        scene_id=scene_id,
        object_name=CLASS_NAMES[SCENE_CLASSES[scene_id // 5 % 20]],
        subject=SUBJECTS[scene_id // 100],
    )
