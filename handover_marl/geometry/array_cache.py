"""Cache files of arrays computed from object models, in the user's cache folder.

Several processes may share the folder: files are written atomically, and arrays are computed again if a file is
unreadable.
"""

import hashlib
import logging
import os
import tempfile
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt

from handover_marl.errors import HandoverError
from handover_marl.execution.files import write_arrays
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.geometry.model_files.meshes import list_mesh_files

Arrays = dict[str, npt.NDArray[Any]]

_log = logging.getLogger(__name__)


def get_cache_folder(kind: str) -> Path:
    """Return the folder `handover_marl/KIND` in the user's cache folder, which is XDG_CACHE_HOME or else ~/.cache.

    For users without a home folder, as in some containers, it is in `cache-UID` in the folder for temporary files.
    """
    folder = os.environ.get("XDG_CACHE_HOME")
    try:
        caches = Path(folder) if folder else Path.home() / ".cache"
    except RuntimeError:
        caches = Path(tempfile.gettempdir()) / f"cache-{os.getuid()}"
    return caches / "handover_marl" / kind


def get_cache_path(kind: str, urdf: Path, *parameters: bytes) -> Path:
    """Return the path of the cache file for an object model in the folder `get_cache_folder(kind)`.

    The file name has a hash of the URDF file, its collision meshes and `parameters`, which must be all other inputs
    from which the arrays are computed.
    """
    digest = hashlib.sha256(b"".join(parameters))
    for path in (urdf, *list_mesh_files(urdf, "collision")):
        digest.update(read_plain_file(path))
    return get_cache_folder(kind) / f"{urdf.parent.name}-{digest.hexdigest()[:16]}.npz"


def load_cached_arrays(path: Path, names: Sequence[str], what: str) -> Arrays | None:
    """Load arrays by name from a cache file; return None if it is missing or unreadable.

    For an unreadable file, a warning is logged, in which `what` names the content, e.g. "distance field".
    """
    try:
        return read_arrays(path, tuple(names)) if path.exists() else None
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("%s: %s cannot be read (%s); computing it again", path, what, error)
        return None


def save_cached_arrays(path: Path, arrays: Arrays, what: str) -> None:
    """Write arrays by name to a cache file; if that fails, log a warning, in which `what` names the content."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, arrays)
    except (OSError, HandoverError):
        _log.warning("%s %s not saved: cannot write to that folder; it is computed again each time", what, path)
