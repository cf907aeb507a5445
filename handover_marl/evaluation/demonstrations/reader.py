"""Reader of the episodes that `demonstrate` records."""

import contextlib
import json
import operator
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.observations import Observation, receiver_observation_space
from handover_marl.episode.spaces import check_obs_mode, receiver_action_space
from handover_marl.errors import DataFormatError, DataNotFoundError, check_name
from handover_marl.evaluation.demonstrations.demonstration import (
    Demonstration,
    EpisodeMetadata,
    read_demonstration,
    read_episode_metadata,
    read_transitions,
)
from handover_marl.evaluation.results.metadata import ResultMetadata, read_result_metadata
from handover_marl.evaluation.results.result_folder import (
    check_scalar,
    find_demonstrations,
    get_demonstrations_metadata_path,
    read_results,
)
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_plain_file

_MAX_METADATA_BYTES = 10_000


class Demonstrations:
    """Sequence of the episodes that `demonstrate` recorded, as NumPy arrays: `demonstrations[0].actions`.

    Episodes are in the order of the split. No file stays open, so that the object can be pickled.

    Args:
        folder: Output folder of `demonstrate`, also of one that is not finished.

    Attributes:
        folder: Output folder of `demonstrate`.
        fps: Frames per second; None if the rows are the receiver's decisions.
        observation_space: Space of the recorded receiver's observations, a `gymnasium.spaces.Dict`.
        action_space: Space of the recorded receiver's actions, target positions of its 9 joints (rad, m).
        evaluation: Identity of the evaluation that was recorded.

    Raises:
        DataNotFoundError: The folder has no demonstrations.
        DataFormatError: The description of the demonstrations is damaged.
        ResultsError: The folder is no result folder.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = check_path("folder", folder)
        path = get_demonstrations_metadata_path(self.folder)
        if not path.exists():
            raise DataNotFoundError(
                f"{path} does not exist: the folder has no demonstrations; `handover-marl demonstrate --out` records "
                "them"
            )
        with _report_damage(path):
            content = json.loads(read_plain_file(path, _MAX_METADATA_BYTES))
            check_obs_mode(content["obs_mode"])
            largest_class = check_scalar("largest_class", content["largest_class"], int)
            self.observation_space = receiver_observation_space(content["obs_mode"], largest_class)
            fps = content["fps"]
            self.fps: int | None = None if fps is None else check_scalar("fps", fps, int)
        self.action_space: spaces.Box = receiver_action_space()
        self.evaluation: ResultMetadata = read_result_metadata(self.folder)
        self._paths = find_demonstrations(self.folder)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._paths)

    def __getitem__(self, number: int) -> Demonstration:
        """Read the episode of a given number, with all its arrays.

        Raises:
            TypeError: The number is not an integer; slices are not supported.
            IndexError: The number is out of range.
            DataFormatError: The file of the episode is damaged.
        """
        path = self._paths[operator.index(number)]
        with _report_damage(path):
            return read_demonstration(path, self.observation_space)

    def __iter__(self) -> Iterator[Demonstration]:
        return map(self.__getitem__, range(len(self)))

    def read_metadata(self) -> list[EpisodeMetadata]:
        """Read the metadata of every episode.

        Raises:
            DataFormatError: The file of an episode is damaged.
        """
        return [self._read_metadata(path) for path in self._paths]

    def read_transitions(
        self, names: Iterable[str] | None = None, episodes: Iterable[int] | None = None
    ) -> tuple[Observation, npt.NDArray[np.float32]]:
        """Read observations and actions of several episodes, concatenated, for imitation learning.

        Args:
            names: Observations to read, by key; default: all.
            episodes: Episodes to read, by number; default: all.

        Returns:
            Observations (N, ...) by key and actions (N, 9) of N rows.

        Raises:
            UnknownNameError: Unknown observation.
            IndexError: The number of an episode is out of range.
            DataFormatError: The file of an episode is damaged.
        """
        names = list(self.observation_space.spaces if names is None else names)
        for name in names:
            check_name("observation", name, self.observation_space.spaces)
        paths = self._paths if episodes is None else [self._paths[number] for number in episodes]
        parts = []
        for path in paths:
            with _report_damage(path):
                parts.append(read_transitions(path, names, self.observation_space))
        observations = {
            name: np.concatenate(
                [_create_empty_rows(self.observation_space[name]), *(arrays[name][:-1] for arrays, _ in parts)]
            )
            for name in names
        }
        return observations, np.concatenate([_create_empty_rows(self.action_space), *(actions for _, actions in parts)])

    def __str__(self) -> str:
        source = self.evaluation
        outcomes = Counter(result.status.label for result in read_results(self.folder, allow_empty=True))
        counts = ", ".join(f"{name} {number}" for name, number in sorted(outcomes.items()))
        return (
            f"{len(self)} episodes of {source.receiver}, giver {source.giver}, {source.dataset}, {source.setup} "
            f"{source.split}, {source.physics} physics; {source.recorded}.\nSimulated: {outcomes.total()} ({counts}). "
            f"Files: {get_demonstrations_metadata_path(self.folder).parent}"
        )

    @staticmethod
    def _read_metadata(path: Path) -> EpisodeMetadata:
        with _report_damage(path):
            return read_episode_metadata(path)


@contextlib.contextmanager
def _report_damage(path: Path) -> Iterator[None]:
    """Report every exception of reading a file as damage.

    Raises:
        DataFormatError: The file cannot be read.
    """
    try:
        yield
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(
            f"{path} cannot be read ({shorten_text(error)}); remove it and run the same command again to record its "
            "episode again"
        ) from error


def _create_empty_rows(space: spaces.Space[Any]) -> npt.NDArray[Any]:
    """Return an array with no rows, which gives concatenations without episodes their shape and type."""
    return np.zeros((0, *(space.shape or ())), dtype=space.dtype)
