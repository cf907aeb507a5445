"""Recorder of demonstrations, and base class of writers that keep one file per recorded episode."""

import contextlib
import re
from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from handover_marl.episode.callbacks import PolicyDecision
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation, select_receiver_observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, STATE
from handover_marl.errors import ResultsError
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.demonstrations.demonstration import Demonstration, EpisodeMetadata
from handover_marl.evaluation.demonstrations.episode_groups import encode_episode
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.writers import EpisodeRecorder, EpisodeWriter
from handover_marl.execution.files import remove_stale_temporaries, shorten_text, write_atomically

EPISODES_FOLDER = "episodes"

_Location = TypeVar("_Location")


@dataclass(frozen=True)
class RecordingConfig:
    """Configuration of the recording of demonstrations.

    Attributes:
        obs_mode: Observation mode of the recorded observations, one of
            `handover_marl.episode.spaces.OBS_MODES`; independent of the receiver's own mode.
        successes_only: Whether only successful episodes are recorded.
        fps: Frames per second of LeRobot's format; 0 records every decision, in Minari's layout.
    """

    obs_mode: str = STATE
    successes_only: bool = False
    fps: int = 0

    def includes(self, status: EpisodeStatus) -> bool:
        """Return whether an episode with this outcome is recorded."""
        return status == EpisodeStatus.SUCCESS or not self.successes_only

    def describe(self, config: EvaluationConfig) -> str:
        """Describe the recording in text that is part of the identity of the result folder."""
        camera = config.camera.describe(self.obs_mode, config.physics)
        parts = ["demonstrations", *([f"lerobot, {self.fps} fps"] if self.fps else [])]
        return ", ".join([*parts, f"obs_mode {self.obs_mode}", *([camera] if camera else [])])


def observe(episode: Episode, obs_mode: str) -> Observation:
    """Return the receiver's present observation in an observation mode."""
    state = {name: value.copy() for name, value in episode.observe().items()}
    return select_receiver_observation(state, episode.observe_camera(obs_mode), obs_mode)


class DemonstrationRecorder(EpisodeRecorder):
    """Recorder of observations and actions at every decision, encoded as an HDF5 file.

    Args:
        recording: Observation mode, and choice of the episodes to record.
        config: Resolved configuration of the evaluation.
    """

    def __init__(self, recording: RecordingConfig, config: EvaluationConfig) -> None:
        self._recording, self._config = recording, config
        self._observations: list[Observation] = []
        self._steps: list[int] = []
        self._actions: list[npt.NDArray[np.float32]] = []
        self._giver_steps: list[int] = []
        self._giver_actions: list[npt.NDArray[np.float32]] = []

    def on_reset(self, episode: Episode) -> None:
        """Discard the recording of the previous episode."""
        for recorded in (self._observations, self._steps, self._actions, self._giver_steps, self._giver_actions):
            recorded.clear()

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        """Record the observation and the actions of a decision."""
        if decision.receiver_decided:
            self._record_observation(episode)
            self._actions.append(decision.receiver_action.copy())
        if decision.giver_decided:
            self._giver_steps.append(episode.steps)
            self._giver_actions.append(decision.giver_action.copy())

    def on_end(self, episode: Episode) -> None:
        """Record the observation at the end of the episode."""
        if self._recording.includes(episode.status):
            self._record_observation(episode)

    def encode(self, result: EpisodeResult) -> bytes:
        """Return the content of the episode's HDF5 file; empty if it is not to be recorded."""
        return encode_episode(self._build(result)) if self._recording.includes(result.status) else b""

    def _record_observation(self, episode: Episode) -> None:
        self._observations.append(observe(episode, self._recording.obs_mode))
        self._steps.append(episode.steps)

    def _build(self, result: EpisodeResult) -> Demonstration:
        is_last = np.arange(len(self._actions)) == len(self._actions) - 1
        observations = {
            name: np.stack([observation[name] for observation in self._observations]) for name in self._observations[0]
        }
        return Demonstration(
            observations=observations,
            actions=np.stack(self._actions),
            rewards=(is_last & result.success).astype(np.float64),
            # As in the environments, contact or drop in the step of the time limit sets both.
            terminations=is_last & bool(result.status & ~EpisodeStatus.TIMEOUT),
            truncations=is_last & bool(result.status & EpisodeStatus.TIMEOUT),
            steps=np.array(self._steps, dtype=np.int64),
            giver_steps=np.array(self._giver_steps, dtype=np.int64),
            giver_actions=np.array(self._giver_actions, dtype=np.float32).reshape(-1, GIVER_ACTION_SIZE),
            metadata=EpisodeMetadata.from_result(result, self._config),
        )


class EpisodeFilesWriter(EpisodeWriter, Generic[_Location]):
    """Writer of one file per recorded episode in the folder `episodes` of a result folder, and of a data set of them.

    Args:
        folder: Result folder of the evaluation, as `open` prepares it.
        config: Resolved configuration of the evaluation.
        recording: Observation mode, frame rate, and choice of the episodes to record.

    Attributes:
        folder: Result folder of the evaluation.
        config: Resolved configuration of the evaluation.
        recording: Observation mode, frame rate, and choice of the episodes to record.

    Raises:
        ResultsError: The data set in the folder is damaged.
    """

    #: Suffix of the files of single episodes, e.g. ".zip".
    suffix: ClassVar[str]

    def __init__(self, folder: Path, config: EvaluationConfig, recording: RecordingConfig) -> None:
        self.folder, self.config, self.recording = folder, config, recording

    @classmethod
    @contextlib.contextmanager
    def open(cls, folder: Path, config: EvaluationConfig, recording: RecordingConfig, fresh: bool) -> Iterator[Self]:
        """Open the writer of a data set in a result folder, locked against other processes.

        Args:
            folder: Result folder of the evaluation.
            config: Resolved configuration of the evaluation.
            recording: Observation mode, frame rate, and choice of the episodes to record.
            fresh: Whether to delete the recordings of an earlier run first.

        Raises:
            ResultsError: The data set in the folder is damaged or has other files, another process records
                in this folder, or it cannot be written.
        """
        episodes = folder / EPISODES_FOLDER
        with contextlib.ExitStack() as stack:
            try:
                cls.prepare_data_set(folder, fresh, stack)
                episodes.mkdir(exist_ok=True)
                remove_stale_temporaries(episodes)
                if fresh:
                    delete_episode_files(episodes, cls.suffix)
            except OSError as error:
                raise ResultsError(f"cannot use {folder} for demonstrations: {error.strerror or error}") from error
            yield cls(folder, config, recording)

    @classmethod
    @abstractmethod
    def prepare_data_set(cls, folder: Path, fresh: bool, stack: contextlib.ExitStack) -> None:
        """Lock the data set in a result folder, and delete what interrupted runs left.

        Args:
            folder: Result folder of the evaluation.
            fresh: Whether to delete the data set of an earlier run.
            stack: Context that holds the lock.

        Raises:
            ResultsError: The data set has other files, or another process records in this folder.
            OSError: The folder cannot be used.
        """

    @abstractmethod
    def find_episode(self, metadata: EpisodeMetadata, path: Path) -> _Location | None:
        """Return the location of an episode's recording; None if it does not exist.

        Args:
            metadata: Metadata that the recording must have.
            path: File of the single episode.
        """

    def contains(self, result: EpisodeResult) -> bool:
        """Return whether the episode is recorded already, or is not to be recorded."""
        return not self.recording.includes(result.status) or self._find(result) is not None

    def write(self, result: EpisodeResult, content: bytes) -> None:
        """Write the file of a recorded episode.

        Raises:
            ResultsError: The file cannot be written.
        """
        if content:
            write_atomically(self._get_path(result), content)

    def find_recorded(self, results: Iterable[EpisodeResult]) -> dict[EpisodeResult, _Location]:
        """Return the locations of the recordings of those results that are to be recorded."""
        return {
            result: location
            for result in results
            if self.recording.includes(result.status) and (location := self._find(result)) is not None
        }

    def delete_episode_files(self) -> None:
        """Delete the files of single episodes and their folder.

        Files that cannot be deleted do no harm: their episodes are in the data set.
        """
        with contextlib.suppress(OSError):
            delete_episode_files(self.folder / EPISODES_FOLDER, self.suffix)
            (self.folder / EPISODES_FOLDER).rmdir()

    def _find(self, result: EpisodeResult) -> _Location | None:
        return self.find_episode(EpisodeMetadata.from_result(result, self.config), self._get_path(result))

    def _get_path(self, result: EpisodeResult) -> Path:
        return self.folder / EPISODES_FOLDER / f"{result.index:03d}{self.suffix}"


def delete_episode_files(folder: Path, suffix: str) -> None:
    """Delete the files of single episodes in a folder; other files are kept.

    Raises:
        OSError: A file cannot be deleted.
    """
    name = re.compile(r"[0-9]{3,7}" + re.escape(suffix))
    for path in folder.iterdir():
        if name.fullmatch(path.name):
            path.unlink()


@contextlib.contextmanager
def report_damage(path: Path) -> Iterator[None]:
    """Report every exception of reading a data set as damage.

    Args:
        path: File or folder of the data set.

    Raises:
        ResultsError: The data set is damaged.
    """
    try:
        yield
    except Exception as error:  # h5py and pyarrow raise exceptions of many types on damaged files
        raise ResultsError(
            f"{path} is damaged or no data set of this library ({shorten_text(error)}); remove it and run again to "
            "record its episodes again, or choose another folder"
        ) from error
