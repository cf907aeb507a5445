"""Access to the HDF5 files of data sets; h5py is an optional dependency."""

import importlib
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from handover_marl.errors import OptionError
from handover_marl.evaluation.demonstrations.minari_layout import format_group_name
from handover_marl.execution.files import replace_atomically

#: HDF5 format versions that are written: compact for many small arrays, readable since HDF5 1.10 (2016).
HDF5_VERSIONS = ("v110", "v110")


def require_h5py() -> None:
    """Check that h5py is installed.

    Raises:
        OptionError: h5py is not installed.
    """
    if importlib.util.find_spec("h5py") is None:
        raise OptionError("demonstrations need h5py: pip install 'handover-marl[demonstrations]'")


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


def assemble_data_set(path: Path, locations: Sequence[EpisodeLocation]) -> None:
    """Copy recorded episodes into the file of a data set, without decompressing them.

    Args:
        path: File to write.
        locations: Episodes in the order of the data set.

    Raises:
        ResultsError: The file cannot be written.
    """
    with replace_atomically(path) as temporary:
        _copy_episodes(locations, temporary)


def _copy_episodes(locations: Sequence[EpisodeLocation], target: Path) -> None:
    with open_hdf5(target, "w") as file:
        for number, location in enumerate(locations):
            with open_hdf5(location.file, "r") as source:
                source.copy(source[location.group], file, name=format_group_name(number))
            file[format_group_name(number)].attrs["id"] = number


def count_decisions(path: Path) -> int:
    """Count the receiver's decisions in all episodes of a data set file."""
    with open_hdf5(path, "r") as file:
        return sum(int(file[name].attrs["total_steps"]) for name in file)
