"""Writer of demonstrations in a result folder.

There is one file per episode during the recording, and one data set after it:

```
config.yaml, 000.npz, ..., report.json, report.md   results, as in every evaluation
episodes/000.hdf5, ...                              episodes that are not in the data set yet
data/main_data.hdf5, metadata.json, README.md       data set in Minari's layout, and its card
```
"""

import contextlib
from pathlib import Path

from handover_marl.episode.observations import receiver_observation_space
from handover_marl.episode.spaces import receiver_action_space
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.demonstrations.data_card import CARD_FILE
from handover_marl.evaluation.demonstrations.demonstration import EpisodeMetadata
from handover_marl.evaluation.demonstrations.episode_groups import SINGLE_EPISODE_GROUP, read_episode_metadata
from handover_marl.evaluation.demonstrations.files import EpisodeLocation, get_episode_group, open_hdf5
from handover_marl.evaluation.demonstrations.join import assemble_data_set
from handover_marl.evaluation.demonstrations.minari_layout import (
    DATA_FOLDER,
    MAIN_FILE,
    METADATA_FILE,
    format_group_name,
)
from handover_marl.evaluation.demonstrations.recorder import (
    DemonstrationRecorder,
    EpisodeFilesWriter,
    RecordingConfig,
    report_damage,
)
from handover_marl.evaluation.results.result_folder import read_results
from handover_marl.evaluation.writers import EpisodeRecorder
from handover_marl.execution.files import exclusive_lock, remove_stale_temporaries
from handover_marl.policies.policy import Policy


class DemonstrationWriter(EpisodeFilesWriter[EpisodeLocation]):
    """Writer of one HDF5 file per recorded episode, and of the data set made of these files."""

    suffix = ".hdf5"

    def __init__(self, folder: Path, config: EvaluationConfig, recording: RecordingConfig) -> None:
        super().__init__(folder, config, recording)
        self._data_set = folder / DATA_FOLDER / MAIN_FILE
        self._assembled_groups = _read_groups(self._data_set)

    @classmethod
    def prepare_data_set(cls, folder: Path, fresh: bool, stack: contextlib.ExitStack) -> None:
        """Lock the folder of the data set, and delete what interrupted runs left; see `EpisodeFilesWriter`."""
        data = folder / DATA_FOLDER
        data.mkdir(exist_ok=True)
        # The process that assembles a data set deletes single episodes; no other may write them meanwhile.
        stack.enter_context(exclusive_lock(data))
        remove_stale_temporaries(data)
        if fresh:
            for name in (METADATA_FILE, MAIN_FILE, CARD_FILE):
                (data / name).unlink(missing_ok=True)

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create the recorder of demonstrations in one worker process."""
        return DemonstrationRecorder(self.recording, config)

    def find_episode(self, metadata: EpisodeMetadata, path: Path) -> EpisodeLocation | None:
        """Return the location of an episode's recording; None if it does not exist."""
        # h5py raises exceptions of many types on damaged files; such episodes are simulated again.
        with contextlib.suppress(Exception), open_hdf5(path, "r") as file:
            if read_episode_metadata(get_episode_group(file, SINGLE_EPISODE_GROUP)) == metadata:
                return EpisodeLocation(path, SINGLE_EPISODE_GROUP)
        group = self._assembled_groups.get(metadata)
        return None if group is None else EpisodeLocation(self._data_set, group)

    def assemble(self) -> None:
        """Write the data set of all episodes in the split's order; delete the files of single episodes.

        Raises:
            ResultsError: A file in the folder is damaged, or the folder cannot be written.
        """
        results = read_results(self.folder)
        locations = self.find_recorded(results)
        present = None
        if self._data_set.exists():
            names = map(format_group_name, range(len(self._assembled_groups)))
            present = [EpisodeLocation(self._data_set, name) for name in names]
        largest_class = max(self.config.open_dataset().object_names)
        observation_space = receiver_observation_space(self.recording.obs_mode, largest_class)
        assemble_data_set(self.folder, observation_space, receiver_action_space(), results, locations, present)
        self._assembled_groups = _read_groups(self._data_set)
        self.delete_episode_files()


def _read_groups(path: Path) -> dict[EpisodeMetadata, str]:
    """Read the group names of an existing data set, by metadata of the episode."""
    if not path.exists():
        return {}
    with report_damage(path), open_hdf5(path, "r") as file:
        names = list(map(format_group_name, range(len(file))))
        return {read_episode_metadata(get_episode_group(file, name)): name for name in names}
