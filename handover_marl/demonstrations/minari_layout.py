"""Where Minari looks for what: names of files and groups, and `metadata.json`.

Minari's own writer neither packs arrays nor writes files whole, so that files are written here; its reader takes them
as they are.
"""

import json
import math
import re
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from handover_marl.benchmarking.settings import RunSettings
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.files import brief

DATA_FOLDER, MAIN_FILE, METADATA_FILE = "data", "main_data.hdf5", "metadata.json"
# The first version of Minari that reads what is written; before, pictures were JPEG, which loses.
_READABLE_BY, _PICTURES_READABLE_BY = "0.5.3", "0.5.4"
_OWN_SECTION = "handover_marl"
_LARGEST = 64_000_000  # bytes; bounds are written out for every component
_LARGEST_SPACE = 10_000_000  # components of an observation


@dataclass(frozen=True)
class DataSetFacts:
    """What a data set is.

    Attributes:
        settings: The run that it was recorded in.
        observation_space: What the receiver is shown.
        action_space: What it does.
        played: Episodes by outcome, all that were played.
        kept: Likewise, those of them that are in the data set.
        decisions: Decisions of the receiver in these.
        megabytes: Their size.
    """

    settings: RunSettings
    observation_space: spaces.Dict
    action_space: spaces.Box
    played: Mapping[str, int]
    kept: Mapping[str, int]
    decisions: int
    megabytes: float

    @property
    def episodes(self) -> int:
        """Episodes in the data set."""
        return sum(self.kept.values())


def group_name(number: int) -> str:
    """The group of an episode."""
    return f"episode_{number}"


def metadata_text(facts: DataSetFacts) -> str:
    """`metadata.json`."""
    settings = facts.settings
    pictures = any(space.dtype == np.uint8 for space in facts.observation_space.values())
    content = {
        "dataset_id": _data_set_id(settings),
        "minari_version": _PICTURES_READABLE_BY if pictures else _READABLE_BY,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "total_episodes": facts.episodes,
        "total_steps": facts.decisions,
        "dataset_size": facts.megabytes,
        "observation_space": json.dumps(_told(facts.observation_space)),
        "action_space": json.dumps(_told(facts.action_space)),
        "algorithm_name": settings.receiver,
        "description": (
            f"Human-to-robot handovers of receiver {settings.receiver} with giver {settings.giver}, "
            f"{settings.dataset}, {settings.setup} {settings.split}, {settings.physics} physics. One step is one "
            "decision of the receiver."
        ),
        _OWN_SECTION: {"settings": asdict(settings), "played": dict(facts.played), "kept": dict(facts.kept)},
    }
    return json.dumps(content) + "\n"


def read_metadata(folder: Path) -> DataSetFacts:
    """What `metadata.json` says.

    Args:
        folder: The folder that it is in.

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: It cannot be what it should be.
    """
    path = folder / METADATA_FILE
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode) or state.st_size > _LARGEST:
            raise ValueError(f"no file of less than {_LARGEST // 1_000_000} MB")
        content = json.loads(path.read_bytes())
        own = content[_OWN_SECTION]
        facts = DataSetFacts(
            settings=RunSettings(**{name: str(value) for name, value in own["settings"].items()}),
            observation_space=_read_dict(json.loads(content["observation_space"])),
            action_space=_read_box(json.loads(content["action_space"])),
            played=_counts(own["played"]),
            kept=_counts(own["kept"]),
            decisions=int(content["total_steps"]),
            megabytes=float(content["dataset_size"]),
        )
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataNotFoundError(
            f"{path} does not exist: no demonstrations there, or they were not finished; "
            "`handover-marl demonstrate --out` makes them and goes on with them"
        ) from error
    except Exception as error:  # whatever the file holds
        raise DataFormatError(f"{path}: not a description of demonstrations ({brief(error)})") from error
    return facts


def _data_set_id(settings: RunSettings) -> str:
    """What Minari calls the data set."""
    words = (settings.dataset, settings.setup, settings.split, settings.receiver, settings.giver, settings.physics)
    return f"handover_marl/{re.sub(r'[^A-Za-z0-9_-]+', '-', '-'.join(words))}-v0"


def _told(space: spaces.Space[Any]) -> dict[str, Any]:
    """A space as Minari writes it."""
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "subspaces": {name: _told(part) for name, part in space.spaces.items()}}
    if not isinstance(space, spaces.Box):
        raise TypeError(f"{space} is no box")
    bounds = {"low": space.low.tolist(), "high": space.high.tolist()}
    return {"type": "Box", "dtype": str(space.dtype), "shape": list(space.shape), **bounds}


def _read_dict(told: Any) -> spaces.Dict:
    if told["type"] != "Dict":
        raise ValueError("observations are no dictionary")
    return spaces.Dict({str(name): _read_box(part) for name, part in told["subspaces"].items()})


def _read_box(told: Any) -> spaces.Box:
    shape, dtype = tuple(map(int, told["shape"])), np.dtype(told["dtype"])
    if told["type"] != "Box" or dtype.kind not in "fiu" or math.prod(shape) > _LARGEST_SPACE:
        raise ValueError("a space that the library does not write")
    low, high = (np.array(told[name], dtype=dtype) for name in ("low", "high"))
    return spaces.Box(low, high, shape, dtype.type)


def _counts(told: Any) -> dict[str, int]:
    counts = {str(name): int(number) for name, number in told.items()}
    if any(number < 0 for number in counts.values()):
        raise ValueError("a negative number of episodes")
    return counts
