"""Assembly of a data set from recorded episodes or from the data sets of shards."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from gymnasium import spaces

from handover_marl.errors import ResultsError
from handover_marl.evaluation.demonstrations.files import EpisodeLocation, assemble_data_set, count_decisions
from handover_marl.evaluation.demonstrations.minari_layout import (
    DATA_FOLDER,
    MAIN_FILE,
    METADATA_FILE,
    DataSetMetadata,
    format_group_name,
    format_metadata,
)
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import read_result_metadata
from handover_marl.evaluation.results.result_folder import read_results
from handover_marl.execution.files import write_atomically


def join_data_sets(parts: Sequence[Demonstrations], folder: Path) -> None:
    """Write the data set of a whole evaluation, joined from the data sets of all its shards.

    Args:
        parts: Data sets of the shards.
        folder: Result folder of the whole evaluation, with its results.

    Raises:
        DataFormatError: A data set is damaged.
        ResultsError: The folder cannot be written.
    """
    locations = {
        metadata.scene_id: EpisodeLocation(part.folder / DATA_FOLDER / MAIN_FILE, format_group_name(number))
        for part in parts
        for number, metadata in enumerate(part.read_metadata())
    }
    results = read_results(folder)
    recorded = [result for result in results if result.scene_id in locations]
    data_folder = folder / DATA_FOLDER
    try:
        data_folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot use {folder} for demonstrations: {error.strerror or error}") from error
    assemble_data_set(data_folder / MAIN_FILE, [locations[result.scene_id or 0] for result in recorded])
    write_metadata(folder, parts[0].observation_space, parts[0].action_space, results, recorded)


def write_metadata(
    folder: Path,
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    simulated: Iterable[EpisodeResult],
    recorded: Iterable[EpisodeResult],
) -> None:
    """Write `metadata.json` of an assembled data set.

    Args:
        folder: Result folder of the evaluation.
        observation_space: Space of the receiver's observations.
        action_space: Space of the receiver's actions.
        simulated: Results of all simulated episodes.
        recorded: Results of the episodes in the data set.

    Raises:
        ResultsError: The file cannot be written.
    """
    path = folder / DATA_FOLDER / MAIN_FILE
    metadata = DataSetMetadata(
        evaluation=read_result_metadata(folder),
        observation_space=observation_space,
        action_space=action_space,
        simulated=_count_outcomes(simulated),
        recorded=_count_outcomes(recorded),
        decisions=count_decisions(path),
        megabytes=round(path.stat().st_size / 1e6, 1),
    )
    write_atomically(path.with_name(METADATA_FILE), format_metadata(metadata))


def _count_outcomes(results: Iterable[EpisodeResult]) -> dict[str, int]:
    return dict(sorted(Counter(result.status.label for result in results).items()))
