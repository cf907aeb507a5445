"""Conversion of demonstrations to Minari's format; Minari is an optional dependency."""

import importlib
import os
import warnings
from dataclasses import asdict
from pathlib import Path

from handover_marl.errors import OptionError
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import require_modules


def convert_to_minari(folder: str | os.PathLike[str], name: str) -> Path:
    """Write demonstrations as a data set of Minari, which `minari.load_dataset(name)` loads.

    Minari stores it in its own folder, see its variable MINARI_DATASETS_PATH. One step of the data set is one row of
    the demonstrations. `infos` has the physics steps and the giver's actions in effect, and the metadata of an
    episode has the fields of `EpisodeMetadata`.

    Args:
        folder: Output folder of `demonstrate`.
        name: Name of the data set, such as "handover/reactive-v0".

    Returns:
        Folder of the data set.

    Raises:
        OptionError: Minari is not installed, or refuses the name, for instance because it exists.
        DataNotFoundError, DataFormatError: The folder has no demonstrations, or they are damaged.
    """
    demonstrations = Demonstrations(folder)
    require_modules("a data set of Minari", "minari", "h5py", "minari")
    minari = importlib.import_module("minari")
    source = demonstrations.evaluation
    try:
        with warnings.catch_warnings():
            # Minari asks for an author, an environment and a link to code.
            warnings.simplefilter("ignore", UserWarning)
            dataset = minari.create_dataset_from_buffers(
                name,
                [],
                observation_space=demonstrations.observation_space,
                action_space=demonstrations.action_space,
                algorithm_name=source.receiver,
                description=str(demonstrations),
                jpeg_encoding=False,
            )
    except (OSError, ValueError) as error:
        raise OptionError(f"name must be a new data set of Minari, got {name!r} ({shorten_text(error)})") from error
    # Episode by episode, since all of them may not fit into memory.
    for number, demonstration in enumerate(demonstrations):
        buffer = minari.data_collector.EpisodeBuffer(
            options={"scene_id": demonstration.metadata.scene_id},
            observations=demonstration.observations,
            actions=demonstration.actions,
            rewards=demonstration.rewards,
            terminations=demonstration.terminations,
            truncations=demonstration.truncations,
            infos={"steps": demonstration.steps, "giver_actions": demonstration.hold_giver_actions()},
        )
        dataset.update_dataset_from_buffer([buffer])
        dataset.storage.update_episode_metadata([asdict(demonstration.metadata)], [number])
    return Path(dataset.storage.data_path)
