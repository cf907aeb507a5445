"""Reading demonstrations."""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.benchmarking.settings import RunSettings
from handover_marl.demonstrations.demonstration import Demonstration, EpisodeFacts
from handover_marl.demonstrations.episode_groups import read_actions, read_episode, read_facts, read_observations
from handover_marl.demonstrations.hdf5 import check_hdf5, open_hdf5
from handover_marl.demonstrations.minari_layout import DATA_FOLDER, MAIN_FILE, group_name, read_metadata
from handover_marl.episode.observations import Observation
from handover_marl.errors import DataFormatError, UnknownNameError
from handover_marl.files import brief

_Value = TypeVar("_Value")


class Demonstrations:
    """A folder that `demonstrate` made, as NumPy arrays: `demonstrations[0].actions`.

    It holds no file open, so that it may be sent to other processes. `minari.MinariDataset(folder / "data")` reads the
    same data.

    Args:
        folder: The folder.

    Raises:
        DataNotFoundError: There is no data set in it.
        DataFormatError: It is damaged.
        OptionError: h5py is not installed.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        check_hdf5()
        self.folder = Path(folder)
        self._about = read_metadata(self.folder / DATA_FOLDER)
        self._file = self.folder / DATA_FOLDER / MAIN_FILE

    @property
    def observation_space(self) -> spaces.Dict:
        """What the receiver is shown: `handover_marl.episode.observations.receiver_observation_space`."""
        return self._about.observation_space

    @property
    def action_space(self) -> spaces.Box:
        """What it does: `handover_marl.episode.spaces.receiver_action_space`."""
        return self._about.action_space

    @property
    def settings(self) -> RunSettings:
        """The run that was recorded."""
        return self._about.settings

    def __len__(self) -> int:
        """Episodes."""
        return self._about.episodes

    def __getitem__(self, number: int) -> Demonstration:
        """An episode, with all its arrays.

        Raises:
            IndexError: There are not so many.
            DataFormatError: It is damaged.
        """
        chosen = range(len(self))[number]
        return self._read(chosen, lambda group: read_episode(group, self.observation_space))

    def __iter__(self) -> Iterator[Demonstration]:
        return map(self.__getitem__, range(len(self)))

    def facts(self) -> list[EpisodeFacts]:
        """What there is to know about every episode without its arrays.

        Raises:
            DataFormatError: The data set is damaged.
        """
        return [self._read(number, read_facts) for number in range(len(self))]

    def decisions(
        self, names: Iterable[str] | None = None, episodes: Iterable[int] | None = None
    ) -> tuple[Observation, npt.NDArray[np.float32]]:
        """What was seen and done at every decision of several episodes, one after another: to learn from by imitation.

        Args:
            names: Only these observations; nothing else is read.
            episodes: Only these episodes, by number.

        Returns:
            Observations (N, ...) by name, and actions (N, 9).

        Raises:
            UnknownNameError: There is no such observation.
            IndexError: There is no such episode.
            DataFormatError: The data set is damaged.
        """
        wanted = list(self.observation_space.spaces if names is None else names)
        for name in wanted:
            if name not in self.observation_space.spaces:
                raise UnknownNameError("observation", name, self.observation_space.spaces)
        chosen = [range(len(self))[number] for number in (range(len(self)) if episodes is None else episodes)]
        parts = [self._read(number, lambda group: self._decided(group, wanted)) for number in chosen]
        seen = {
            name: np.concatenate([_none(self.observation_space[name]), *(part[0][name][:-1] for part in parts)])
            for name in wanted
        }
        return seen, np.concatenate([_none(self.action_space), *(part[1] for part in parts)])

    def __str__(self) -> str:
        about, settings = self._about, self._about.settings
        played = ", ".join(f"{name} {number}" for name, number in about.played.items())
        return (
            f"{len(self)} episodes with {about.decisions} decisions of {settings.receiver}, giver {settings.giver}, "
            f"{settings.dataset}, {settings.setup} {settings.split}, {settings.physics} physics; {settings.kept}.\n"
            f"Played: {sum(about.played.values())} ({played}). {about.megabytes} MB in {self._file}"
        )

    def _decided(self, group: Any, names: list[str]) -> tuple[Observation, npt.NDArray[np.float32]]:
        return read_observations(group, names, self.observation_space), read_actions(group)

    def _read(self, number: int, read: Callable[[Any], _Value]) -> _Value:
        try:
            with open_hdf5(self._file, "r") as file:
                return read(file[group_name(number)])
        except Exception as error:  # what h5py meets in damaged files has no end
            raise DataFormatError(
                f"{self._file}: episode {number} cannot be read ({brief(error)}); remove the file and run the same "
                "command again to record its episodes anew"
            ) from error


def _none(space: spaces.Space[Any]) -> npt.NDArray[Any]:
    """No rows of a space, so that there is something to put together even without episodes."""
    return np.zeros((0, *(space.shape or ())), dtype=space.dtype)
