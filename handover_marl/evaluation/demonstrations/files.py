"""Access to the HDF5 files of data sets; h5py is an optional dependency."""

import importlib
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from handover_marl.execution.options import require_modules
from handover_marl.execution.reading import check_plain_file

#: HDF5 format versions that are written: compact for many small arrays, readable since HDF5 1.10 (2016).
HDF5_VERSIONS = ("v110", "v110")
_MAX_MEMBERS = 1000  # arrays and groups of an episode


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
        ValueError: The file is read, but is not a plain file.
        OSError: The file cannot be opened or is not an HDF5 file.
    """
    require_h5py()
    if mode == "r" and isinstance(file, Path):
        check_plain_file(file, sys.maxsize)  # its arrays are read one by one
    h5py: ModuleType = importlib.import_module("h5py")
    # Files are written under a unique temporary name that is locked already. Files that are read may be open elsewhere
    # in this process, in Minari, and have to be opened with the same default locking.
    locking = {"locking": False} if mode == "w" and isinstance(file, Path) else {}
    return h5py.File(file, mode, libver=HDF5_VERSIONS, **locking)


def get_episode_group(file: Any, name: str) -> Any:
    """Return the group of an episode from an open HDF5 file; all its arrays must be in this file.

    Links, external arrays and virtual arrays could take their content from any file of this machine.

    Args:
        file: Open HDF5 file.
        name: Name of the group.

    Raises:
        ValueError: The group does not exist, or it or a member is not stored in the file itself.
    """
    h5py: ModuleType = importlib.import_module("h5py")
    waiting, count = [(file, name)], 0
    while waiting:
        parent, child = waiting.pop()
        count += 1
        if count > _MAX_MEMBERS:
            raise ValueError(f"{name} has more than {_MAX_MEMBERS} members")
        is_inside = isinstance(parent.get(child, getlink=True), h5py.HardLink)
        if not is_inside:
            raise ValueError(f"{child} of {parent.name} is missing, or a link")
        member = parent[child]
        if isinstance(member, h5py.Group):
            waiting += [(member, inner) for inner in itertools.islice(member, _MAX_MEMBERS)]
        elif member.external or member.is_virtual:
            raise ValueError(f"{member.name} is stored in another file")
    return file[name]


@dataclass(frozen=True)
class EpisodeLocation:
    """Location of a recorded episode: an HDF5 file and the name of the group in it."""

    file: Path
    group: str
