"""Merge of the result folders of all shards into the folder of the whole evaluation."""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.crossplay import CROSSPLAY_CSV, CrossPlay, format_pair_folder
from handover_marl.evaluation.demonstrations.demonstration import Demonstrations
from handover_marl.evaluation.metadata import ResultMetadata, format_merged_config, read_result_metadata
from handover_marl.evaluation.reports.report import Report, load_report, write_report
from handover_marl.evaluation.results import (
    DEMONSTRATIONS,
    ResultFolder,
    find_recordings,
    get_result_path,
    read_results,
)
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_plain_file, report_damage

_MAX_LISTED = 8  # missing scenes that an error lists


def merge(
    folders: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str]
) -> Report | CrossPlay | Demonstrations:
    """Merge the folders of all shards, parts of the scenes such as "3/16", into one folder of the whole evaluation.

    Nothing is simulated, and nothing is written unless all shards are complete.

    Args:
        folders: Folders of the shards, in any order: of `benchmark`, `evaluate_pair`, `crossplay` or
            `demonstrate`.
        out: Folder to create.

    Returns:
        The result that the whole evaluation would have returned.

    Raises:
        ResultsError: The folders are not all shards of one evaluation, one cannot be read, or `out`
            holds another evaluation or cannot be written.
        OptionError: `folders` is not a list of paths, or `out` is not a path.
        DataFormatError: The description of demonstrations is damaged.
    """
    if isinstance(folders, (str, bytes)) or not isinstance(folders, Sequence) or not folders:
        raise OptionError(f"folders must be a list of at least one path, got {folders!r}")
    paths, target = [check_path("folders", folder) for folder in folders], check_path("out", out)
    if target.resolve() in [path.resolve() for path in paths]:
        raise ResultsError(f"{target} is one of the shards; choose another output folder")
    if any((path / CROSSPLAY_CSV).exists() for path in paths):
        pairs = _read_pairs(paths[0] / CROSSPLAY_CSV)
        reports = _merge_subfolders(paths, target, [format_pair_folder(pair) for pair in pairs])
        crossplay = CrossPlay(dict(zip(pairs, reports, strict=True)))
        crossplay.write(target)
        return crossplay
    (report,) = _merge_subfolders(paths, target, (".",))
    return Demonstrations(target) if (target / DEMONSTRATIONS).exists() else report


def _read_pairs(path: Path) -> list[tuple[str, str]]:
    """Read the labels (giver, receiver) of all pairs of a cross-play from its table."""
    try:
        text = read_plain_file(path).decode()
        return [(row["giver"], row["receiver"]) for row in csv.DictReader(io.StringIO(text, newline=""))]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise ResultsError(
            f"{path}: not a cross-play table ({shorten_text(error)}); run the same command to resume"
        ) from error


def _merge_subfolders(paths: Sequence[Path], target: Path, names: Sequence[str]) -> list[Report]:
    """Merge the subfolders `names` of the shards, after reading all, into those of `target`; return their reports."""
    shards = {name: _read_shards([path / name for path in paths]) for name in names}
    return [_write_merged(*read, target / name) for name, read in shards.items()]


def _read_shards(paths: Sequence[Path]) -> tuple[ResultMetadata, dict[int, Path]]:
    """Return the identity of the whole evaluation of which all shards are in `paths`, and its result files by index."""
    found: dict[int, Path] = {}
    scenes: set[int | None] = set()
    first = _read_identity(paths[0])
    for path in paths:
        if different := first.describe_differences(_read_identity(path), f"in {paths[0]}", f"in {path}"):
            raise ResultsError(f"these are shards of different evaluations: {'; '.join(different)}")
        for recording in find_recordings(path):
            # A symbolic link could name any file of this machine.
            if not recording.is_file() or not recording.resolve().is_relative_to(path.resolve()):
                raise ResultsError(f"{recording} is not a file in the result folder; remove it")
        for result in read_results(path, allow_empty=True):
            file = get_result_path(path, result.index)
            if result.index in found:
                raise ResultsError(f"{found[result.index]} and {file} are of the same scene; leave one shard out")
            found[result.index] = file
            scenes.add(result.scene_id)
    n_shards, _, chosen = first.shard.partition(" of ")
    # Selected scenes are identified by number: their index in the split requires the dataset.
    missing = (
        [f"scene {scene}" for scene in map(int, chosen.split(",")) if scene not in scenes]
        if chosen
        else [f"{index:03d}.npz" for index in range(first.split_size) if index not in found]
    )
    if missing:
        listed = ", ".join(missing[:_MAX_LISTED]) + (", ..." if len(missing) > _MAX_LISTED else "")
        raise ResultsError(
            f"these are not all shards, or not finished: {len(missing)} scenes have no result ({listed}); run the "
            f"commands of all {n_shards} shards again to resume"
        )
    return replace(first, shard=""), dict(sorted(found.items()))


def _read_identity(path: Path) -> ResultMetadata:
    """Return a shard's identity without the shard's number: `shard` is "16", or "16 of 209,214" for chosen scenes."""
    metadata = read_result_metadata(path)
    if not metadata.shard:
        raise ResultsError(f"{path} is not a shard: it was evaluated without --shard")
    return replace(metadata, shard=metadata.shard.partition("/")[2])


def _write_merged(metadata: ResultMetadata, files: dict[int, Path], out: Path) -> Report:
    """Write results, recordings and report of the whole evaluation into the folder `out`; return the report."""
    folders = list(dict.fromkeys(file.parent for file in files.values()))
    ResultFolder(out, metadata, format_merged_config(folders[0]))
    for folder in folders:
        for recording in find_recordings(folder):
            copy = out / recording.relative_to(folder)
            copy.parent.mkdir(exist_ok=True)
            _copy_file(recording, copy)
    for index, file in files.items():
        _copy_file(file, get_result_path(out, index))
    report = load_report(out)
    write_report(out, report)
    return report


def _copy_file(source: Path, target: Path) -> None:
    with report_damage(source, "result or recording", "remove it and evaluate its scene again"):
        content = read_plain_file(source)
    write_atomically(target, content)
