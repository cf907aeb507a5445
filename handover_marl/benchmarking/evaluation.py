"""The table of a result folder, ours or the original code's, without running anything."""

import os
from dataclasses import replace
from pathlib import Path

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import read_results
from handover_marl.benchmarking.settings import read_settings
from handover_marl.datasets.splits import SPLIT_SIZES, split_scenes
from handover_marl.errors import ResultsError
from handover_marl.models.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS


def evaluate(folder: str | os.PathLike[str]) -> Report:
    """Recompute the metrics from an official result folder.

    Raises:
        ResultsError: There is no such folder, or it or one of its files is no official result.
    """
    try:
        path = Path(folder).expanduser()
        there = path.is_dir()
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise ResultsError(f"{folder!r} is no result folder ({error})") from error
    if not there:
        raise ResultsError(f"result folder {path} does not exist")
    settings = read_settings(path)
    size = SPLIT_SIZES[settings.setup, settings.split]
    results = read_results(path)
    if results[-1].index >= size:
        raise ResultsError(
            f"{path}: {results[-1].index:03d}.npz has no place in {settings.setup} {settings.split}, which has "
            f"{size} scenes"
        )
    return Report(settings, tuple(_described(result, settings.setup, settings.split) for result in results), size)


def _described(result: EpisodeResult, setup: str, split: str) -> EpisodeResult:
    """Add scene, object and subject to a result of the original code, as far as its index tells them."""
    # In s2 the place of a scene depends on which hand was used, which only the dataset knows.
    if result.scene_id is not None or setup == "s2":
        return result
    scene_id = split_scenes(setup, split, lambda _: "")[result.index]
    return replace(
        result,
        scene_id=scene_id,
        object_name=CLASS_NAMES[SCENE_CLASSES[scene_id // 5 % 20]],
        subject=SUBJECTS[scene_id // 100],
    )
