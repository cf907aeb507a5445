"""Minari's layout of a data set: names of files and groups, and `metadata.json`.

Minari can read the files; docs/decisions/002-minari-writer.md explains why this module writes them.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.evaluation.results.metadata import ResultMetadata, check_metadata
from handover_marl.execution.files import shorten_text
from handover_marl.execution.old_keys import upgrade_keys
from handover_marl.execution.reading import read_plain_file

DATA_FOLDER, MAIN_FILE, METADATA_FILE = "data", "main_data.hdf5", "metadata.json"
# First versions of Minari that read these files; earlier ones stored images as lossy JPEG.
_MIN_MINARI_VERSION, _MIN_MINARI_VERSION_IMAGES = "0.5.3", "0.5.4"
_LIBRARY_SECTION = "handover_marl"
_MAX_FILE_BYTES = 64_000_000  # Bounds of spaces are written out for every component.
_MAX_COMPONENTS = 10_000_000  # of an observation
_MAX_EPISODES = 1_000_000


@dataclass(frozen=True)
class DataSetMetadata:
    """Description of a data set of recorded episodes, stored in `metadata.json`.

    Attributes:
        evaluation: Identity of the evaluation that was recorded.
        observation_space: Space of the receiver's observations.
        action_space: Space of the receiver's actions.
        simulated: Number of simulated episodes by outcome.
        recorded: Number of recorded episodes by outcome.
        decisions: Number of the receiver's decisions in the data set.
        megabytes: Size of the data set (MB).
    """

    evaluation: ResultMetadata
    observation_space: spaces.Dict
    action_space: spaces.Box
    simulated: Mapping[str, int]
    recorded: Mapping[str, int]
    decisions: int
    megabytes: float

    @property
    def n_episodes(self) -> int:
        """Number of episodes in the data set."""
        return sum(self.recorded.values())


def format_group_name(number: int) -> str:
    """Return the name of the HDF5 group of an episode, given its number in the data set."""
    return f"episode_{number}"


def format_metadata(metadata: DataSetMetadata) -> str:
    """Return the content of a data set's `metadata.json`."""
    evaluation = metadata.evaluation
    has_images = any(space.dtype == np.uint8 for space in metadata.observation_space.values())
    content = {
        "dataset_id": _format_data_set_id(evaluation),
        "minari_version": _MIN_MINARI_VERSION_IMAGES if has_images else _MIN_MINARI_VERSION,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "total_episodes": metadata.n_episodes,
        "total_steps": metadata.decisions,
        "dataset_size": metadata.megabytes,
        "observation_space": json.dumps(_encode_space(metadata.observation_space)),
        "action_space": json.dumps(_encode_space(metadata.action_space)),
        "algorithm_name": evaluation.receiver,
        "description": (
            f"Human-to-robot handovers of receiver {evaluation.receiver} with giver {evaluation.giver}, "
            f"{evaluation.dataset}, {evaluation.setup} {evaluation.split}, {evaluation.physics} physics. One step is "
            "one decision of the receiver."
        ),
        _LIBRARY_SECTION: {
            "evaluation": evaluation.to_dict(),
            "simulated": dict(metadata.simulated),
            "recorded": dict(metadata.recorded),
        },
    }
    return json.dumps(content) + "\n"


def read_metadata(folder: Path) -> DataSetMetadata:
    """Read a data set's `metadata.json`, written by this version or by 0.7.0.

    Args:
        folder: Folder of the file.

    Raises:
        DataNotFoundError: The file does not exist.
        DataFormatError: The file is malformed.
    """
    path = folder / METADATA_FILE
    try:
        content = json.loads(read_plain_file(path, _MAX_FILE_BYTES))
        section = upgrade_keys(content[_LIBRARY_SECTION])
        metadata = DataSetMetadata(
            evaluation=ResultMetadata(**{name: str(value) for name, value in section["evaluation"].items()}),
            observation_space=_decode_dict(json.loads(content["observation_space"])),
            action_space=_decode_box(json.loads(content["action_space"])),
            simulated=_check_counts(section["simulated"]),
            recorded=_check_counts(section["recorded"]),
            decisions=int(content["total_steps"]),
            megabytes=float(content["dataset_size"]),
        )
        check_metadata(metadata.evaluation, path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataNotFoundError(
            f"{path} does not exist: the folder has no demonstrations, or they are not finished; "
            "`handover-marl demonstrate --out` records them and resumes"
        ) from error
    except Exception as error:  # the file may have any content
        raise DataFormatError(f"{path}: not a description of demonstrations ({shorten_text(error)})") from error
    return metadata


def _format_data_set_id(evaluation: ResultMetadata) -> str:
    parts = (
        evaluation.dataset,
        evaluation.setup,
        evaluation.split,
        evaluation.receiver,
        evaluation.giver,
        evaluation.physics,
    )
    return f"handover_marl/{re.sub(r'[^A-Za-z0-9_-]+', '-', '-'.join(parts))}-v0"


def _encode_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """Encode a Gymnasium space as Minari does."""
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "subspaces": {name: _encode_space(part) for name, part in space.spaces.items()}}
    if not isinstance(space, spaces.Box):
        raise TypeError(f"space must be a Dict or a Box, got {space}")
    bounds = {"low": space.low.tolist(), "high": space.high.tolist()}
    return {"type": "Box", "dtype": str(space.dtype), "shape": list(space.shape), **bounds}


def _decode_dict(encoded: Any) -> spaces.Dict:
    if encoded["type"] != "Dict":
        raise ValueError("the observation space is no dictionary")
    return spaces.Dict({str(name): _decode_box(part) for name, part in encoded["subspaces"].items()})


def _decode_box(encoded: Any) -> spaces.Box:
    shape, dtype = tuple(map(int, encoded["shape"])), np.dtype(encoded["dtype"])
    if encoded["type"] != "Box" or dtype.kind not in "fiu" or math.prod(shape) > _MAX_COMPONENTS:
        raise ValueError("the space is not one that this library writes")
    low, high = (np.array(encoded[name], dtype=dtype) for name in ("low", "high"))
    return spaces.Box(low, high, shape, dtype.type)


def _check_counts(counts: Any) -> dict[str, int]:
    checked = {str(name): int(number) for name, number in counts.items()}
    if not all(0 <= number <= _MAX_EPISODES for number in checked.values()):
        raise ValueError(f"a number of episodes is not from 0 to {_MAX_EPISODES}")
    return checked
