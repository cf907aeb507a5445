"""Writer of demonstrations in LeRobot's format, in a result folder.

There is one archive per episode during the recording, and one data set after it:

```
config.yaml, 000.npz, ..., report.json, report.md   results, as in every evaluation
episodes/000.zip, ...                               episodes that are not in the data set yet
lerobot/meta, lerobot/data, lerobot/videos          data set, replaced as a whole
```
"""

import contextlib
import shutil
import tempfile
from pathlib import Path

from handover_marl.errors import ResultsError
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.demonstrations.data_card import count_outcomes
from handover_marl.evaluation.demonstrations.demonstration import EpisodeMetadata
from handover_marl.evaluation.demonstrations.lerobot.data_set import (
    ENTRIES,
    DataSetContent,
    EpisodeFiles,
    read_episodes,
    write_data_set,
    write_description,
)
from handover_marl.evaluation.demonstrations.lerobot.encoded_episode import read_metadata
from handover_marl.evaluation.demonstrations.lerobot.recorder import LeRobotRecorder
from handover_marl.evaluation.demonstrations.lerobot.summary import LeRobotSummary
from handover_marl.evaluation.demonstrations.recorder import EpisodeFilesWriter, RecordingConfig, report_damage
from handover_marl.evaluation.results.metadata import read_result_metadata
from handover_marl.evaluation.results.result_folder import read_results
from handover_marl.evaluation.writers import EpisodeRecorder
from handover_marl.execution.files import exclusive_lock
from handover_marl.policies.policy import Policy

LEROBOT_FOLDER = "lerobot"
_PREVIOUS, _TEMPORARY_PREFIX = ".lerobot.previous", ".lerobot.part."


class LeRobotWriter(EpisodeFilesWriter[EpisodeFiles]):
    """Writer of one archive per recorded episode, and of the data set made of these archives."""

    suffix = ".zip"

    def __init__(self, folder: Path, config: EvaluationConfig, recording: RecordingConfig) -> None:
        super().__init__(folder, config, recording)
        self._assembled = _read_assembled(folder / LEROBOT_FOLDER)

    @classmethod
    def prepare_data_set(cls, folder: Path, fresh: bool, stack: contextlib.ExitStack) -> None:
        """Lock the result folder, and delete what interrupted runs left; see `EpisodeFilesWriter`."""
        data = folder / LEROBOT_FOLDER
        stack.enter_context(exclusive_lock(folder))
        _restore_interrupted(folder)
        foreign = sorted(path.name for path in data.iterdir() if path.name not in ENTRIES) if data.exists() else []
        if foreign:
            raise ResultsError(f"{data} is replaced as a whole, but it has other files: {foreign[0]}; move them")
        if fresh:
            shutil.rmtree(data, ignore_errors=True)

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create the recorder of demonstrations in one worker process."""
        return LeRobotRecorder(self.recording, config)

    def find_episode(self, metadata: EpisodeMetadata, path: Path) -> EpisodeFiles | None:
        """Return the location of an episode's recording; None if it does not exist."""
        # Damaged archives raise errors of many types; their episodes are simulated again.
        with contextlib.suppress(Exception):
            episode = EpisodeFiles.from_archive(path)
            if read_metadata(episode.row) == metadata:
                return episode
        return self._assembled.get(metadata)

    def assemble(self) -> LeRobotSummary:
        """Write the data set of all episodes in the split's order; delete the archives of single episodes.

        Raises:
            ResultsError: A file in the folder is damaged, or the folder cannot be written.
        """
        target, results = self.folder / LEROBOT_FOLDER, read_results(self.folder)
        recorded = self.find_recorded(results)
        metadata = read_result_metadata(self.folder)
        content = DataSetContent(metadata, self.recording.obs_mode, self.recording.fps, results, list(recorded))
        episodes = list(recorded.values())
        frames = sum(episode.row["length"] for episode in episodes)
        try:
            if not target.exists() or episodes != list(self._assembled.values()):
                self._replace(target, content, episodes)
            write_description(target, content, frames)
        except OSError as error:
            raise ResultsError(
                f"cannot write {target} ({error.strerror or error}); recorded episodes are kept: free space or fix the "
                "folder, then run the same command again to resume"
            ) from error
        self._assembled = _read_assembled(target)
        self.delete_episode_files()
        counts = count_outcomes(results), count_outcomes(recorded)
        return LeRobotSummary(target, self.recording.fps, frames, metadata, *counts)

    def _replace(self, target: Path, content: DataSetContent, episodes: list[EpisodeFiles]) -> None:
        """Write the data set under a temporary name, then rename it."""
        temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY_PREFIX, dir=self.folder))
        try:
            write_data_set(temporary, content, episodes)
            temporary.chmod(0o755)
            if target.exists():
                target.rename(self.folder / _PREVIOUS)
            temporary.rename(target)
        finally:
            _restore_interrupted(self.folder)


def _read_assembled(folder: Path) -> dict[EpisodeMetadata, EpisodeFiles]:
    """Read the locations of a data set's episodes, by their metadata."""
    with report_damage(folder):
        return {read_metadata(episode.row): episode for episode in read_episodes(folder)}


def _restore_interrupted(folder: Path) -> None:
    """Undo an interrupted replacement of the data set, and delete what replacements leave."""
    previous, target = folder / _PREVIOUS, folder / LEROBOT_FOLDER
    if previous.exists():
        if target.exists():
            shutil.rmtree(previous)
        else:
            previous.rename(target)
    for path in folder.glob(f"{_TEMPORARY_PREFIX}*"):
        shutil.rmtree(path)
