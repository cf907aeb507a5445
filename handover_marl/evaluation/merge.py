"""Merge of the result folders of shards into one folder."""

import os
from collections.abc import Sequence
from pathlib import Path

from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.crossplay import CROSSPLAY_CSV, CrossPlay, format_pair_folder, read_pairs
from handover_marl.evaluation.demonstrations.demonstration import Demonstrations
from handover_marl.evaluation.metadata import CONFIG_FILE
from handover_marl.evaluation.reports.report import Report, load_report, write_report
from handover_marl.evaluation.results import DEMONSTRATIONS, DEMONSTRATIONS_METADATA, find_numbered, find_recordings
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_plain_file, report_damage


def merge(
    folders: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str]
) -> Report | CrossPlay | Demonstrations:
    """Merge the folders of shards, parts of the scenes such as "3/16", into one folder of the whole evaluation.

    Nothing is simulated. The report states how many scenes of the split have a result.

    Args:
        folders: Folders of the shards, in any order: of `benchmark`, `evaluate_pair`, `crossplay` or
            `demonstrate`.
        out: New or empty folder.

    Returns:
        The result that the whole evaluation would have returned.

    Raises:
        ResultsError: The folders are of different evaluations or have results of the same scene, one cannot be read,
            or `out` is not empty or cannot be written.
        OptionError: `folders` is not a list of paths, or `out` is not a path.
        DataFormatError: A result, a recording or the description of demonstrations is damaged.
    """
    if isinstance(folders, (str, bytes)) or not isinstance(folders, Sequence) or not folders:
        raise OptionError(f"folders must be a list of at least one path, got {folders!r}")
    paths, target = [check_path("folders", folder) for folder in folders], check_path("out", out)
    pairs = read_pairs(paths[0]) if any((path / CROSSPLAY_CSV).exists() for path in paths) else []
    names = [format_pair_folder(pair) for pair in pairs] or [""]
    files = {name: _find_files([path / name for path in paths]) for name in names}
    if len({tuple(sorted(path for path in copies if path.suffix == ".npz")) for copies in files.values()}) > 1:
        raise ResultsError("not all pairs have results of the same scenes; run the shards' commands again to resume")
    _copy_files(files, target)
    reports = [load_report(target / name) for name in names]
    for name, report in zip(names, reports, strict=True):
        write_report(target / name, report)
    if pairs:
        crossplay = CrossPlay(dict(zip(pairs, reports, strict=True)))
        crossplay.write(target)
        return crossplay
    return Demonstrations(target) if (target / DEMONSTRATIONS).exists() else reports[0]


def _find_files(folders: Sequence[Path]) -> dict[Path, Path]:
    """Return the results and recordings of all shards of an evaluation by their paths in the merged folder."""
    first, files = load_report(folders[0]).metadata, {Path(CONFIG_FILE): folders[0] / CONFIG_FILE}
    for folder in folders:
        different = first.describe_differences(load_report(folder).metadata, f"in {folders[0]}", f"in {folder}")
        if different:
            raise ResultsError(f"these are shards of different evaluations: {'; '.join(different)}")
        for file in (*find_numbered(folder, ".npz").values(), *find_recordings(folder)):
            # A symbolic link could name any file of this machine.
            if not file.is_file() or not file.resolve().is_relative_to(folder.resolve()):
                raise ResultsError(f"{file} is not a file in the result folder; remove it")
            name = file.relative_to(folder)
            if name in files and name.name != DEMONSTRATIONS_METADATA:
                raise ResultsError(f"{files[name]} and {file} are of the same scene; leave one shard out")
            files[name] = file
    return files


def _copy_files(files: dict[str, dict[Path, Path]], target: Path) -> None:
    """Copy the files of each subfolder, by their paths in it, to a new or empty folder."""
    try:
        target.mkdir(parents=True, exist_ok=True)
        if any(not entry.name.startswith(".") for entry in target.iterdir()):
            raise ResultsError(f"{target} is not empty; choose another output folder")
        for path in {target / name / copy for name, copies in files.items() for copy in copies}:
            path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot use {target}: {error.strerror or error}; choose another output folder") from error
    for name, copies in files.items():
        for copy, source in copies.items():
            with report_damage(source, "result or recording", "remove it and evaluate its scene again"):
                content = read_plain_file(source)
            write_atomically(target / name / copy, content)
