"""The library behind HDF5 files, which is an extra."""

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

from handover_marl.errors import OptionError

#: File versions that are written: compact for many small arrays, and readable since HDF5 1.10 (2016).
VERSIONS = ("v110", "v110")


def check_hdf5() -> None:
    """See whether it is installed.

    Raises:
        OptionError: It is not.
    """
    if importlib.util.find_spec("h5py") is None:
        raise OptionError("demonstrations need h5py: pip install 'handover-marl[demonstrations]'")


def open_hdf5(file: object, mode: str) -> Any:
    """An HDF5 file, to be used in a with block.

    Args:
        file: Its path, or a stream.
        mode: "r" or "w".

    Raises:
        OptionError: h5py is not installed.
        OSError: It cannot be opened, or is no such file.
    """
    check_hdf5()
    h5py: ModuleType = importlib.import_module("h5py")
    # What is written has a name that nobody else knows, and a lock of ours already. What is read may be open elsewhere
    # in this process, with Minari, and then has to be opened in the same way, which is the usual one.
    locking = {"locking": False} if mode == "w" and isinstance(file, Path) else {}
    return h5py.File(file, mode, libver=VERSIONS, **locking)
