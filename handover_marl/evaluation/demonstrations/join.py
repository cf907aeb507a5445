"""Assembly of a data set from recorded episodes or from the data sets of shards."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from gymnasium import spaces

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.demonstrations.data_card import CARD_FILE, DataCard, FeatureRow, count_outcomes
from handover_marl.evaluation.demonstrations.files import EpisodeLocation, get_episode_group, open_hdf5
from handover_marl.evaluation.demonstrations.minari_layout import (
    DATA_FOLDER,
    MAIN_FILE,
    METADATA_FILE,
    DataSetMetadata,
    format_group_name,
    format_metadata,
)
from handover_marl.evaluation.demonstrations.observation_meanings import (
    GIVER_ACTION_MEANING,
    OBSERVATION_MEANINGS,
    RECEIVER_ACTION_MEANING,
)
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import read_result_metadata
from handover_marl.evaluation.results.result_folder import read_results
from handover_marl.execution.files import replace_atomically, write_atomically

_CONTENTS = """\
`main_data.hdf5` has one group per episode, `metadata.json` the spaces and the outcomes of all episodes; see
[Minari](https://minari.farama.org). One row is one decision of the receiver. Receivers decide at varying periods,
so `infos/steps` gives the time. Observations and steps have one more row, the end of the episode. Attributes of
a group have scene, object, outcome and policies."""
_OTHER_ARRAYS = (
    FeatureRow("actions", "(9,)", "float32", RECEIVER_ACTION_MEANING),
    FeatureRow("rewards", "()", "float64", "1 for the decision that completes the handover, else 0"),
    FeatureRow("terminations", "()", "bool", "success, contact of robot and hand, or drop"),
    FeatureRow("truncations", "()", "bool", "end at the time limit"),
    FeatureRow("infos/steps", "()", "int64", "physics steps (1 ms) since the start at each observation"),
    FeatureRow("attribute giver_steps", "()", "int64", "physics steps of the giver's decisions, if it decides"),
    FeatureRow("attribute giver_actions", "(8,)", "float32", GIVER_ACTION_MEANING),
)


def locate_episodes(part: Demonstrations, results: Sequence[EpisodeResult]) -> dict[int, EpisodeLocation]:
    """Return the locations of a shard's recorded episodes by scene number.

    Args:
        part: Data set of the shard.
        results: Results of the shard.

    Raises:
        DataFormatError: The data set is damaged.
        ResultsError: The recorded episodes are neither all episodes nor all successful ones.
    """
    episodes = part.read_metadata()
    statuses = {episode.scene_id: episode.status for episode in episodes}
    simulated = {result.scene_id: int(result.status) for result in results}
    successes = {scene: status for scene, status in simulated.items() if status == EpisodeStatus.SUCCESS}
    if len(statuses) < len(episodes) or statuses not in (simulated, successes):
        raise ResultsError(
            f"{part.folder}: the data set must have the episodes of all results, or of all successes, got "
            f"{len(episodes)} episodes for {len(simulated)} results; run the same command again to record them again"
        )
    file = part.folder / DATA_FOLDER / MAIN_FILE
    return {
        episode.scene_id: EpisodeLocation(file, format_group_name(number)) for number, episode in enumerate(episodes)
    }


def join_data_sets(first: Demonstrations, locations: Mapping[int, EpisodeLocation], folder: Path) -> None:
    """Write the data set of a whole evaluation, joined from the data sets of all its shards.

    Args:
        first: Data set of a shard; observation and action spaces are equal in all shards.
        locations: Location of each recorded episode, by scene number.
        folder: Result folder of the whole evaluation, with its results.

    Raises:
        ResultsError: The folder cannot be written.
    """
    results = read_results(folder)
    try:
        (folder / DATA_FOLDER).mkdir(exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot use {folder} for demonstrations: {error.strerror or error}") from error
    episodes = {result: locations[result.scene_id] for result in results if result.scene_id in locations}  # type: ignore[index]
    assemble_data_set(folder, first.observation_space, first.action_space, results, episodes)


def assemble_data_set(
    folder: Path,
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    simulated: Sequence[EpisodeResult],
    recorded: Mapping[EpisodeResult, EpisodeLocation],
    present: Sequence[EpisodeLocation] | None = None,
) -> None:
    """Write a data set, its `metadata.json` and its card; episodes are copied without decompressing them.

    Args:
        folder: Result folder of the evaluation, with its subfolder for data.
        observation_space: Space of the receiver's observations.
        action_space: Space of the receiver's actions.
        simulated: Results of all simulated episodes.
        recorded: Location of each recorded episode, in the order of the data set.
        present: Episodes of an existing data set, which is kept if these are the recorded ones.

    Raises:
        ResultsError: A file cannot be written.
    """
    path, locations = folder / DATA_FOLDER / MAIN_FILE, list(recorded.values())
    if locations != present:
        with replace_atomically(path) as temporary:
            _copy_episodes(locations, temporary)
    with open_hdf5(path, "r") as file:
        decisions = sum(int(file[name].attrs["total_steps"]) for name in file)
    metadata = DataSetMetadata(
        evaluation=read_result_metadata(folder),
        observation_space=observation_space,
        action_space=action_space,
        simulated=count_outcomes(simulated),
        recorded=count_outcomes(recorded),
        decisions=decisions,
        megabytes=round(path.stat().st_size / 1e6, 1),
    )
    write_atomically(path.with_name(CARD_FILE), _make_card(metadata, simulated, list(recorded)).format())
    write_atomically(path.with_name(METADATA_FILE), format_metadata(metadata))


def _copy_episodes(locations: Sequence[EpisodeLocation], target: Path) -> None:
    with open_hdf5(target, "w") as file:
        for number, location in enumerate(locations):
            with open_hdf5(location.file, "r") as source:
                source.copy(get_episode_group(source, location.group), file, name=format_group_name(number))
            file[format_group_name(number)].attrs["id"] = number


def _make_card(
    metadata: DataSetMetadata, simulated: Sequence[EpisodeResult], recorded: Sequence[EpisodeResult]
) -> DataCard:
    return DataCard(
        evaluation=metadata.evaluation,
        format_name="Minari's layout (HDF5)",
        simulated=simulated,
        recorded=recorded,
        contents=f"{metadata.n_episodes} episodes with {metadata.decisions} decisions. {_CONTENTS}",
        row="decision",
        features=[*_list_observations(metadata.observation_space), *_OTHER_ARRAYS],
        front_matter="- Minari\n",
    )


def _list_observations(space: spaces.Dict) -> list[FeatureRow]:
    return [
        FeatureRow(f"observations/{name}", str(part.shape), str(part.dtype), OBSERVATION_MEANINGS.get(name, ""))
        for name, part in space.items()
    ]
