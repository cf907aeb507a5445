"""Merge of the result folders of all shards into the folder of the whole evaluation."""

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handover_marl.errors import HandoverError, OptionError, ResultsError
from handover_marl.evaluation.agreement import AGREEMENT_FILE, Agreement
from handover_marl.evaluation.crossplay import CROSSPLAY_CSV, CrossPlay, format_pair_folder, read_crossplay_pairs
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate, write_report
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import (
    CONFIG_FILE,
    ResultMetadata,
    format_merged_config,
    read_result_metadata,
)
from handover_marl.evaluation.results.result_folder import (
    find_recordings,
    get_demonstrations_metadata_path,
    get_result_path,
    prepare_result_folder,
    read_results,
)
from handover_marl.evaluation.shards import Shard
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import check_plain_file, read_plain_file
from handover_marl.simulation.engines import EXACT, PHYSICS

_MAX_LISTED = 8  # missing scenes that an error lists


def merge(
    folders: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str]
) -> Report | CrossPlay | Agreement | Demonstrations:
    """Merge the result folders of all shards (`shard="3/16"`) into one folder of the whole evaluation.

    Nothing is simulated, and nothing is written unless all shards are complete.

    Args:
        folders: Folders of the shards, in any order: of `benchmark`, `evaluate_pair`, `crossplay`,
            `compare_physics` or `demonstrate`.
        out: Folder to create.

    Returns:
        The result that the whole evaluation would have returned.

    Raises:
        ResultsError: The folders are not all shards of one evaluation, one cannot be read, or `out`
            holds another evaluation or cannot be written.
        OptionError: `folders` is not a list of paths, or `out` is not a path.
        DataFormatError: The description of demonstrations is damaged.
    """
    if isinstance(folders, (str, bytes)) or not isinstance(folders, Sequence):
        raise OptionError(f"folders must be a list of paths, got {folders!r}")
    paths, target = [check_path("folders", folder) for folder in folders], check_path("out", out)
    if not paths:
        raise ResultsError("folders must name at least one shard, got none")
    try:
        return _merge(paths, target)
    except HandoverError:
        raise
    except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle
        raise ResultsError(f"cannot read the shards: {error}") from error


@dataclass(frozen=True)
class ShardFolder:
    """Results in the folder of one shard of an evaluation.

    Attributes:
        path: Path of the result folder.
        metadata: Identity of the evaluation.
        part: Number of the shard, and the scenes of the whole evaluation.
        results: Results of the finished scenes, ordered by index in the split.
    """

    path: Path
    metadata: ResultMetadata
    part: Shard
    results: tuple[EpisodeResult, ...]

    @classmethod
    def read(cls, path: Path) -> "ShardFolder":
        """Read the result folder of a shard.

        Raises:
            ResultsError: The folder does not belong to a shard, or a file in it is damaged.
        """
        if not path.is_dir():
            raise ResultsError(f"result folder {path} does not exist")
        metadata = read_result_metadata(path)
        if not metadata.shard:
            raise ResultsError(f"{path} is not a shard: it was evaluated without --shard")
        try:
            part = Shard.parse(metadata.shard, with_scenes=True)
        except OptionError as error:
            raise ResultsError(f"{path}: {error}") from error
        for recording in find_recordings(path):
            _check_recording(path, recording)
        return cls(path, metadata, part, tuple(read_results(path, allow_empty=True)))

    @property
    def name(self) -> str:
        """Path of the folder and number of the shard, for error messages."""
        return f"{self.path} (shard {self.part.name})"

    def describe_missing(self) -> list[str]:
        """Describe the scenes of the shard that have no result; empty if all have one.

        Raises:
            ResultsError: The folder has a result of another shard.
        """
        scenes = self.part.scenes
        expected = set(self.part.list_positions(self.metadata.split_size))
        positions = {scene: position for position, scene in enumerate(scenes or ())}
        found = set()
        for result in self.results:
            # Selected scenes are identified by number: their index in the split requires the dataset.
            position = result.index if scenes is None else positions.get(result.scene_id or 0)
            if position not in expected:
                raise ResultsError(f"{self.name}: {result.index:03d}.npz belongs to another shard; remove it")
            found.add(position)
        missing = [
            f"{position:03d}.npz" if scenes is None else f"scene {scenes[position]}"
            for position in sorted(expected - found)
        ]
        if not missing:
            return []
        names = ", ".join(missing[:_MAX_LISTED]) + (", ..." if len(missing) > _MAX_LISTED else "")
        return [
            f"{self.name} lacks {len(missing)} of {len(expected)} scenes ({names}); run its command again to resume"
        ]


def _read_shards(paths: Sequence[Path]) -> list[ShardFolder]:
    """Read the folders of all shards of one evaluation and sort them by shard number.

    Raises:
        ResultsError: The folders belong to different evaluations, a shard is given twice, or shards or
            scenes are missing.
    """
    folders = sorted((ShardFolder.read(path) for path in paths), key=lambda folder: folder.part.number)
    first = folders[0]
    for folder in folders[1:]:
        _check_same_evaluation(first, folder)
    for one, other in itertools.pairwise(folders):
        if one.part.number == other.part.number:
            raise ResultsError(f"{one.path} and {other.path} are both shard {one.part.name}; leave one out")
    count, numbers = first.part.count, {folder.part.number for folder in folders}
    missing = [f"shard {number}/{count}" for number in range(1, count + 1) if number not in numbers]
    reasons = [f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"] if missing else []
    reasons += [line for folder in folders for line in folder.describe_missing()]
    if reasons:
        raise ResultsError("these are not all shards: " + "; ".join(reasons))
    return folders


def _write_merged(folders: Sequence[ShardFolder], out: Path) -> Report:
    """Write results, replays, demonstrations and report of the whole evaluation.

    Raises:
        ResultsError: `out` holds another evaluation or cannot be written.
    """
    first = folders[0]
    prepare_result_folder(out, replace(first.metadata, shard=""), format_merged_config(first.path))
    for folder in folders:
        for result in folder.results:
            content = _read_file(get_result_path(folder.path, result.index))
            write_atomically(get_result_path(out, result.index), content)
        for recording in find_recordings(folder.path):
            copy = out / recording.relative_to(folder.path)
            copy.parent.mkdir(exist_ok=True)
            write_atomically(copy, _read_file(recording))
    report = evaluate(out)
    write_report(out, report)
    return report


def _merge(paths: list[Path], target: Path) -> Report | CrossPlay | Agreement | Demonstrations:
    if target.resolve() in [path.resolve() for path in paths]:
        raise ResultsError(f"{target} is one of the shards; choose another output folder")
    for file, merge_shards in (
        (CONFIG_FILE, _merge_results),
        (CROSSPLAY_CSV, _merge_crossplay),
        (AGREEMENT_FILE, _merge_agreement),
    ):
        if any((path / file).exists() for path in paths):
            return merge_shards(paths, target)
    raise ResultsError(
        f"{paths[0]} is no finished shard: it has neither {CONFIG_FILE}, {CROSSPLAY_CSV} nor {AGREEMENT_FILE}"
    )


def _check_recording(folder: Path, recording: Path) -> None:
    try:
        check_plain_file(recording)
        # A link could name any file of this machine.
        if not recording.resolve().is_relative_to(folder.resolve()):
            raise ValueError("it is a link out of the result folder")
    except (OSError, ValueError) as error:
        raise ResultsError(
            f"{recording}: not a replay page or demonstration ({shorten_text(error)}); remove it"
        ) from error


def _read_file(path: Path) -> bytes:
    try:
        return read_plain_file(path)
    except (OSError, ValueError) as error:
        raise ResultsError(f"cannot read {path} ({shorten_text(error)})") from error


def _merge_agreement(paths: list[Path], target: Path) -> Agreement:
    others = [physics for physics in PHYSICS if physics != EXACT and (paths[0] / physics).is_dir()]
    if len(others) != 1:
        raise ResultsError(
            f"{paths[0]} must have results in exact and one other physics, got {', '.join(others) or 'no other'}"
        )
    agreement = Agreement(*_merge_subfolders(paths, target, (EXACT, *others)))
    agreement.write(target)
    return agreement


def _merge_subfolders(paths: list[Path], target: Path, names: Sequence[str]) -> list[Report]:
    """Merge each of several subfolders of the shards; all are read before anything is written."""
    shards = [_read_shards([path / name for path in paths]) for name in names]
    return [_write_merged(folders, target / name) for folders, name in zip(shards, names, strict=True)]


def _merge_results(paths: list[Path], target: Path) -> Report | Demonstrations:
    report = _write_merged(_read_shards(paths), target)
    return Demonstrations(target) if get_demonstrations_metadata_path(target).exists() else report


def _merge_crossplay(paths: list[Path], target: Path) -> CrossPlay:
    pairs = read_crossplay_pairs(paths[0])
    for path in paths[1:]:
        if read_crossplay_pairs(path) != pairs:
            raise ResultsError(f"{paths[0]} and {path} must have the same policies in the same order")
    reports = _merge_subfolders(paths, target, [format_pair_folder(pair) for pair in pairs])
    givers, receivers = (tuple(dict.fromkeys(pair[position] for pair in pairs)) for position in (0, 1))
    result = CrossPlay(givers, receivers, dict(zip(pairs, reports, strict=True)))
    result.write(target)
    return result


def _check_same_evaluation(one: ShardFolder, other: ShardFolder) -> None:
    first, second = (replace(folder.metadata, shard="") for folder in (one, other))
    different = first.describe_differences(second, f"in {one.path}", f"in {other.path}")
    if one.part.count != other.part.count:
        different.append(f"{one.name}, {other.name}")
    elif one.part.scenes != other.part.scenes:
        different.append(f"different scenes were selected for {one.path} and {other.path}")
    if different:
        raise ResultsError(f"these are shards of different evaluations: {'; '.join(different)}")
