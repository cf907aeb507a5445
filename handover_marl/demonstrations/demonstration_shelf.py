"""Demonstrations in a result folder: one file an episode while they are recorded, one data set when they are complete.

```
config.yaml, 000.npz, ..., report.json, report.md   the run, as of every benchmark
episodes/000.hdf5, ...                              episodes that are not in the data set yet
data/main_data.hdf5, data/metadata.json             the data set, in Minari's layout
```
"""

import contextlib
import re
from pathlib import Path

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.results import read_results
from handover_marl.benchmarking.scribes import ScribeMaker, Shelf
from handover_marl.benchmarking.settings import read_settings
from handover_marl.demonstrations.data_set_files import EpisodePlace, outcomes, put_together, size_of
from handover_marl.demonstrations.demonstration import EpisodeFacts
from handover_marl.demonstrations.demonstration_scribe import Shown
from handover_marl.demonstrations.episode_groups import SINGLE, read_facts
from handover_marl.demonstrations.hdf5 import open_hdf5
from handover_marl.demonstrations.minari_layout import (
    DATA_FOLDER,
    MAIN_FILE,
    METADATA_FILE,
    DataSetFacts,
    group_name,
    metadata_text,
)
from handover_marl.episode.observations import receiver_observation_space
from handover_marl.episode.spaces import receiver_action_space
from handover_marl.errors import ResultsError
from handover_marl.files import alone_in, brief, remove_abandoned, write_atomically
from handover_marl.run import Run

_EPISODES = "episodes"
_EPISODE_FILE = re.compile(r"[0-9]{3}\.hdf5")


class DemonstrationShelf(Shelf):
    """Keeps what a run's episodes show.

    Args:
        shown: What is recorded of them.
    """

    def __init__(self, shown: Shown) -> None:
        self._shown = shown
        self._alone = contextlib.ExitStack()

    @property
    def scribe(self) -> ScribeMaker:
        """Who records."""
        return self._shown

    def described(self, run: Run) -> str:
        """What is recorded, in words."""
        sees = run.camera.described(self._shown.sight, self._shown.observe, run.physics)
        return f"demonstrations, {sees or 'without sight'}"

    def open(self, folder: Path, run: Run, fresh: bool) -> None:
        """As `Shelf.open`.

        Raises:
            ResultsError: The data set that is there is damaged, another process records in this folder, or it cannot
                be written.
        """
        self._run, self._folder = run, folder
        self._data, self._episodes = folder / DATA_FOLDER, folder / _EPISODES
        try:
            for made in (self._data, self._episodes):
                made.mkdir(exist_ok=True)
            # Who puts a data set together removes single episodes, and must not meet who writes them.
            self._alone.enter_context(alone_in(self._data))
            for made in (self._data, self._episodes):
                remove_abandoned(made)
            if fresh:
                self._clear()
        except OSError as error:
            raise ResultsError(f"cannot use {folder} for demonstrations: {error.strerror or error}") from error
        self._finished = self._read_main()

    def close(self) -> None:
        """Let others record in this folder."""
        self._alone.close()

    def has(self, result: EpisodeResult) -> bool:
        """Whether the episode is there, or is none to keep."""
        return not self._wanted(result) or self._place(result) is not None

    def keep(self, result: EpisodeResult, written: bytes) -> None:
        """Write the file of an episode.

        Raises:
            ResultsError: It cannot be written.
        """
        if written:
            write_atomically(self._episode_path(result), written)

    def assemble(self) -> DataSetFacts:
        """Make one data set of all that the folder has, ordered as the split; the files of single episodes go.

        Raises:
            ResultsError: Something in the folder is damaged, or it cannot be written.
        """
        results = read_results(self._folder)
        places = {result: place for result in results if self._wanted(result) and (place := self._place(result))}
        main = self._data / MAIN_FILE
        there = [EpisodePlace(main, group_name(number)) for number in range(len(self._finished))]
        if list(places.values()) != there or not main.exists():
            put_together(main, list(places.values()))
        self._finished = self._read_main()
        facts = DataSetFacts(
            settings=read_settings(self._folder),
            observation_space=receiver_observation_space(self._shown.sight, self._shown.observe),
            action_space=receiver_action_space(),
            played=outcomes(result.status.label for result in results),
            kept=outcomes(result.status.label for result in places),
            **size_of(main),
        )
        write_atomically(self._data / METADATA_FILE, metadata_text(facts))
        self._remove_single()
        return facts

    def _wanted(self, result: EpisodeResult) -> bool:
        return result.success or not self._shown.successes

    def _episode_path(self, result: EpisodeResult) -> Path:
        return self._episodes / f"{result.index:03d}.hdf5"

    def _place(self, result: EpisodeResult) -> EpisodePlace | None:
        """Where this very episode is, if anywhere: another one of the scene does not count."""
        facts, path = EpisodeFacts.of(result, self._run), self._episode_path(result)
        # What h5py meets in damaged files has no end; the episode is played again then.
        with contextlib.suppress(Exception), open_hdf5(path, "r") as file:
            if read_facts(file[SINGLE]) == facts:
                return EpisodePlace(path, SINGLE)
        group = self._finished.get(facts)
        return None if group is None else EpisodePlace(self._data / MAIN_FILE, group)

    def _read_main(self) -> dict[EpisodeFacts, str]:
        """The groups of the data set that is there, by what is known of the episodes."""
        path = self._data / MAIN_FILE
        if not path.exists():
            return {}
        try:
            with open_hdf5(path, "r") as file:
                return {read_facts(file[name]): name for name in map(group_name, range(len(file)))}
        except Exception as error:  # what h5py meets in damaged files has no end
            raise ResultsError(
                f"{path} is damaged or no data set of this library ({brief(error)}); remove it and run again to record "
                "its episodes anew, or choose another folder"
            ) from error

    def _remove_single(self) -> None:
        with contextlib.suppress(OSError):  # they are in the data set; what stays does no harm
            for path in self._episodes.iterdir():
                if _EPISODE_FILE.fullmatch(path.name):
                    path.unlink()
            self._episodes.rmdir()

    def _clear(self) -> None:
        for name in (METADATA_FILE, MAIN_FILE):
            (self._data / name).unlink(missing_ok=True)
        for path in self._episodes.iterdir():
            if _EPISODE_FILE.fullmatch(path.name):
                path.unlink()
