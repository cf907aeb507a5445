"""What came of trying out the grasps of known objects, so that nobody has to wait for it again.

Made by `python -m handover_marl.assets.building.build_trials`. There are no grasps in it, only how each of those that
a data folder brings has stood its trials (see `handover_marl.receivers.reactive.grasps`), by a hash of all that was
tried.
"""

import functools
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from handover_marl.assets.object_models import DATA_ROOT
from handover_marl.errors import DataFormatError

TRIALS_PATH = DATA_ROOT / "trials.npz"

#: What came of trials, (n, 4): which tilted copy a grasp is (-1: a known one, in their order), how many trials of its
#: place and those beside it it stood, by which of the ways it was moved on (0: not at all), and from how many places
#: the fingers kept the object when it was let go.
Record = npt.NDArray[np.int16]


def shipped_trials(name: str, path: Path = TRIALS_PATH) -> Record | None:
    """The record (n, 4) of this name, or None if none ships.

    Raises:
        DataFormatError: The file is damaged.
    """
    record = all_trials(path).get(name)
    return None if record is None else record.copy()


@functools.cache
def all_trials(path: Path) -> MappingProxyType[str, Record]:
    """All records of a file by name; none if there is no file.

    Raises:
        DataFormatError: It is damaged.
    """
    if not path.is_file():
        return MappingProxyType({})
    try:
        with np.load(path, allow_pickle=False) as archive:
            records = {name: archive[name] for name in archive.files}
    except Exception as error:  # what NumPy and zipfile raise on damaged bytes has no end
        raise DataFormatError(f"{path}: not a readable file of trials ({error}); install the library again") from error
    for name, record in records.items():
        if record.dtype != np.int16 or record.ndim != 2 or record.shape[1] != 4:
            raise DataFormatError(f"{path}: {name} must be integers of shape (n, 4); install the library again")
    return MappingProxyType(records)
