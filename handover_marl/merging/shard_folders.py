"""Result folders of shards: whether they are all the parts of one run, and the one folder made of them."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.evaluation import evaluate
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import (
    claim_folder,
    finished_indices,
    read_results,
    replay_path,
    replay_paths,
    result_path,
)
from handover_marl.benchmarking.settings import RunSettings, read_settings, whole_config_text
from handover_marl.benchmarking.writing import write_report
from handover_marl.datasets.shards import ShardOfRun
from handover_marl.errors import OptionError, ResultsError
from handover_marl.files import write_atomically

_MOST_NAMED = 8  # missing scenes that an error names


@dataclass(frozen=True)
class ShardFolder:
    """A result folder with a shard.

    Attributes:
        path: The folder.
        settings: What is run.
        part: Which shard.
        results: What of it is finished, by index.
    """

    path: Path
    settings: RunSettings
    part: ShardOfRun
    results: tuple[EpisodeResult, ...]

    @classmethod
    def read(cls, path: Path) -> "ShardFolder":
        """What a folder says it is.

        Raises:
            ResultsError: It is no result folder, or not that of a shard, or a file in it is damaged.
        """
        if not path.is_dir():
            raise ResultsError(f"result folder {path} does not exist")
        settings = read_settings(path)
        if not settings.shard:
            raise ResultsError(f"{path} is no shard: it was run without --shard")
        try:
            part = ShardOfRun.parse(settings.shard)
        except OptionError as error:
            raise ResultsError(f"{path}: {error}") from error
        return cls(path, settings, part, tuple(read_results(path)) if finished_indices(path) else ())

    @property
    def name(self) -> str:
        """What errors call it."""
        return f"{self.path} (shard {self.part.shard})"

    def lacks(self) -> list[str]:
        """What of the shard is not there, in words.

        Raises:
            ResultsError: There is what is not of this shard.
        """
        expected = set(self.part.places(self.settings.setup, self.settings.split))
        # Chosen scenes are known by their numbers; where they are in the split only the data tell.
        chosen = {scene: -1 - place for place, scene in enumerate(self.part.scenes or ())}
        there = {chosen.get(result.scene_id or 0, result.index): result.index for result in self.results}
        foreign = [index for place, index in there.items() if place not in expected]
        if foreign:
            raise ResultsError(f"{self.name}: {foreign[0]:03d}.npz is not of this shard; was it copied there?")
        missing = [self._told(place) for place in sorted(expected - set(there), reverse=self.part.scenes is not None)]
        if not missing:
            return []
        names = ", ".join(missing[:_MOST_NAMED]) + (", ..." if len(missing) > _MOST_NAMED else "")
        return [f"{self.name} lacks {len(missing)} of {len(expected)} scenes ({names}); its command goes on with it"]

    def _told(self, place: int) -> str:
        return f"{place:03d}.npz" if self.part.scenes is None else f"scene {self.part.scenes[-1 - place]}"


@dataclass(frozen=True)
class ShardSet:
    """All shards of one run, seen to be whole. Made by `read`.

    Attributes:
        folders: Their folders, by number.
        settings: Of the whole run.
    """

    folders: tuple[ShardFolder, ...]
    settings: RunSettings

    @classmethod
    def read(cls, paths: Sequence[Path]) -> "ShardSet":
        """The folders of all shards, in any order.

        Raises:
            ResultsError: They are of different runs, one is there twice, or something is missing.
        """
        folders = sorted((ShardFolder.read(path) for path in paths), key=lambda folder: folder.part.shard.number)
        first = folders[0]
        for folder in folders[1:]:
            _check_same(first, folder)
        for one, other in itertools.pairwise(folders):
            if one.part.shard == other.part.shard:
                raise ResultsError(f"{one.path} and {other.path} are both shard {one.part.shard}; leave one out")
        count, numbers = first.part.shard.count, {folder.part.shard.number for folder in folders}
        missing = [f"shard {number}/{count}" for number in range(1, count + 1) if number not in numbers]
        told = [f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"] if missing else []
        told += [line for folder in folders for line in folder.lacks()]
        if told:
            raise ResultsError("these are not all shards: " + "; ".join(told))
        return cls(tuple(folders), replace(first.settings, shard=""))

    def write(self, out: Path) -> Report:
        """Write the folder of the whole run: results, replays and report.

        Raises:
            ResultsError: The folder holds another run or cannot be written.
        """
        claim_folder(out, self.settings, whole_config_text(self.folders[0].path))
        for folder in self.folders:
            for index in (result.index for result in folder.results):
                write_atomically(result_path(out, index), result_path(folder.path, index).read_bytes())
            for scene, replay in replay_paths(folder.path).items():
                copy = replay_path(out, scene)
                copy.parent.mkdir(exist_ok=True)
                write_atomically(copy, replay.read_bytes())
        report = evaluate(out)
        write_report(out, report)
        return report


def _check_same(one: ShardFolder, other: ShardFolder) -> None:
    first, second = (asdict(replace(folder.settings, shard="")) for folder in (one, other))
    different = [
        f"{key.replace('_', ' ')} {value!r} in {one.path}, {second[key]!r} in {other.path}"
        for key, value in first.items()
        if value != second[key]
    ]
    if one.part.shard.count != other.part.shard.count:
        different.append(f"{one.name}, {other.name}")
    elif one.part.scenes != other.part.scenes:
        different.append(f"other scenes were chosen for {one.path} than for {other.path}")
    if different:
        raise ResultsError(f"these are shards of different runs: {'; '.join(different)}")
