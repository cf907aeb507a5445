"""Reader of the data sets that `demonstrate` records."""

import operator
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.observations import Observation
from handover_marl.errors import DataFormatError, check_name
from handover_marl.evaluation.demonstrations.data_card import describe_recording
from handover_marl.evaluation.demonstrations.demonstration import Demonstration, EpisodeMetadata
from handover_marl.evaluation.demonstrations.episode_groups import (
    read_actions,
    read_episode,
    read_episode_metadata,
    read_observations,
)
from handover_marl.evaluation.demonstrations.files import get_episode_group, open_hdf5, require_h5py
from handover_marl.evaluation.demonstrations.minari_layout import (
    DATA_FOLDER,
    MAIN_FILE,
    METADATA_FILE,
    format_group_name,
    read_metadata,
)
from handover_marl.evaluation.results.metadata import ResultMetadata
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_path

_Value = TypeVar("_Value")
_RECORD_AGAIN = "remove the file and run the same command again to record its episodes again"


class Demonstrations:
    """Sequence of the episodes that `demonstrate` recorded, as NumPy arrays: `demonstrations[0].actions`.

    No file stays open, so that the object can be pickled. `minari.MinariDataset(folder / "data")`
    reads the same data.

    Args:
        folder: Output folder of `demonstrate`.

    Raises:
        DataNotFoundError: The folder has no data set.
        DataFormatError: The data set is damaged.
        OptionError: h5py is not installed.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        require_h5py()
        self.folder = check_path("folder", folder)
        self._metadata = read_metadata(self.folder / DATA_FOLDER)
        self._file = self.folder / DATA_FOLDER / MAIN_FILE
        found = self._open(len)
        if found != len(self):
            raise DataFormatError(
                f"{self._file} has {found} episodes, but {METADATA_FILE} states {len(self)}; run the same command "
                "again to write it again"
            )

    @property
    def observation_space(self) -> spaces.Dict:
        """Space of the recorded receiver's observations, a `gymnasium.spaces.Dict`."""
        return self._metadata.observation_space

    @property
    def action_space(self) -> spaces.Box:
        """Space of the recorded receiver's actions, target positions of its 9 joints (rad, m)."""
        return self._metadata.action_space

    @property
    def evaluation(self) -> ResultMetadata:
        """Identity of the evaluation that was recorded."""
        return self._metadata.evaluation

    def __len__(self) -> int:
        """Return the number of episodes."""
        return self._metadata.n_episodes

    def __getitem__(self, number: int) -> Demonstration:
        """Read the episode of a given number, with all its arrays.

        Raises:
            TypeError: The number is not an integer; slices are not supported.
            IndexError: The number is out of range.
            DataFormatError: The data set is damaged.
        """
        return self._read(
            range(len(self))[operator.index(number)], lambda group: read_episode(group, self.observation_space)
        )

    def __iter__(self) -> Iterator[Demonstration]:
        return map(self.__getitem__, range(len(self)))

    def read_metadata(self) -> list[EpisodeMetadata]:
        """Read the metadata of every episode.

        Raises:
            DataFormatError: The data set is damaged.
        """
        return [self._read(number, read_episode_metadata) for number in range(len(self))]

    def read_transitions(
        self, names: Iterable[str] | None = None, episodes: Iterable[int] | None = None
    ) -> tuple[Observation, npt.NDArray[np.float32]]:
        """Read observations and actions of several episodes, concatenated, for imitation learning.

        Args:
            names: Observations to read, by key; default: all.
            episodes: Episodes to read, by number; default: all.

        Returns:
            Observations (N, ...) by key and actions (N, 9) of N decisions.

        Raises:
            UnknownNameError: Unknown observation.
            IndexError: The number of an episode is out of range.
            DataFormatError: The data set is damaged.
        """
        names = list(self.observation_space.spaces if names is None else names)
        for name in names:
            check_name("observation", name, self.observation_space.spaces)
        numbers = [range(len(self))[number] for number in (range(len(self)) if episodes is None else episodes)]
        parts = [self._read(number, lambda group: self._read_arrays(group, names)) for number in numbers]
        observations = {
            name: np.concatenate(
                [_create_empty_rows(self.observation_space[name]), *(arrays[name][:-1] for arrays, _ in parts)]
            )
            for name in names
        }
        return observations, np.concatenate([_create_empty_rows(self.action_space), *(actions for _, actions in parts)])

    def __str__(self) -> str:
        metadata = self._metadata
        recording = describe_recording(metadata.evaluation, metadata.simulated)
        return (
            f"{len(self)} episodes with {metadata.decisions} decisions of {recording} {metadata.megabytes} MB in "
            f"{self._file}"
        )

    def _read_arrays(self, group: Any, names: list[str]) -> tuple[Observation, npt.NDArray[np.float32]]:
        return read_observations(group, names, self.observation_space), read_actions(group)

    def _read(self, number: int, read: Callable[[Any], _Value]) -> _Value:
        return self._open(lambda file: read(get_episode_group(file, format_group_name(number))), f": episode {number}")

    def _open(self, read: Callable[[Any], _Value], part: str = "") -> _Value:
        try:
            with open_hdf5(self._file, "r") as file:
                return read(file)
        except (PermissionError, MemoryError) as error:  # the file itself may be whole
            raise DataFormatError(f"{self._file}{part} cannot be read ({shorten_text(error)})") from error
        except Exception as error:  # h5py raises exceptions of many types on damaged files
            raise DataFormatError(
                f"{self._file}{part} cannot be read ({shorten_text(error)}); {_RECORD_AGAIN}"
            ) from error


def _create_empty_rows(space: spaces.Space[Any]) -> npt.NDArray[Any]:
    """Return an array with no rows, which gives concatenations without episodes their shape and type."""
    return np.zeros((0, *(space.shape or ())), dtype=space.dtype)
