"""One data set of the data sets of a run's shards."""

from collections.abc import Sequence
from pathlib import Path

from handover_marl.benchmarking.results import read_results
from handover_marl.benchmarking.settings import read_settings
from handover_marl.demonstrations.data_set_files import EpisodePlace, outcomes, put_together, size_of
from handover_marl.demonstrations.demonstrations import Demonstrations
from handover_marl.demonstrations.minari_layout import (
    DATA_FOLDER,
    MAIN_FILE,
    METADATA_FILE,
    DataSetFacts,
    group_name,
    metadata_text,
)
from handover_marl.errors import ResultsError
from handover_marl.files import write_atomically


def join(parts: Sequence[Demonstrations], folder: Path) -> DataSetFacts:
    """Make the data set that one run would have made.

    Args:
        parts: The data sets of all shards.
        folder: The result folder of the whole run, which has its results already.

    Raises:
        DataFormatError: A data set is damaged.
        ResultsError: The folder cannot be written.
    """
    found = {told.scene_id: (part, number, told) for part in parts for number, told in enumerate(part.facts())}
    results = read_results(folder)
    kept = [found[result.scene_id] for result in results if result.scene_id in found]
    data = folder / DATA_FOLDER
    try:
        data.mkdir(exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot use {folder} for demonstrations: {error.strerror or error}") from error
    main = data / MAIN_FILE
    put_together(main, [EpisodePlace(part.folder / DATA_FOLDER / MAIN_FILE, group_name(n)) for part, n, _ in kept])
    told = DataSetFacts(
        settings=read_settings(folder),
        observation_space=parts[0].observation_space,
        action_space=parts[0].action_space,
        played=outcomes(result.status.label for result in results),
        kept=outcomes(told.outcome for _, _, told in kept),
        **size_of(main),
    )
    write_atomically(data / METADATA_FILE, metadata_text(told))
    return told
