"""Access to the HDF5 files of data sets; h5py is an optional dependency."""

import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from handover_marl.execution.options import require_modules

#: HDF5 format versions that are written: compact for many small arrays, readable since HDF5 1.10 (2016).
HDF5_VERSIONS = ("v110", "v110")


def require_h5py() -> None:
    """Check that h5py is installed.

    Raises:
        OptionError: h5py is not installed.
    """
    require_modules("a data set of demonstrations", "demonstrations", "h5py")


def open_hdf5(file: object, mode: str) -> Any:
    """Open an HDF5 file, for use in a `with` block.

    Args:
        file: Path or stream.
        mode: "r" or "w".

    Raises:
        OptionError: h5py is not installed.
        OSError: The file cannot be opened or is not an HDF5 file.
    """
    require_h5py()
    h5py: ModuleType = importlib.import_module("h5py")
    # Files are written under a unique temporary name that is locked already. Files that are read may be open elsewhere
    # in this process, in Minari, and have to be opened with the same default locking.
    locking = {"locking": False} if mode == "w" and isinstance(file, Path) else {}
    return h5py.File(file, mode, libver=HDF5_VERSIONS, **locking)


@dataclass(frozen=True)
class EpisodeLocation:
    """Location of a recorded episode: an HDF5 file and the name of the group in it."""

    file: Path
    group: str
