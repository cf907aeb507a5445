"""Cache files of arrays computed from object models, in the user's cache folder.

Several processes may share the folder: files are written atomically, and unreadable files are computed again.
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
    """Return the user's cache folder for one kind of files, below XDG_CACHE_HOME if that is set.

    Users without a home folder, as in some containers, have it in the folder for temporary files.
    """
    folder = os.environ.get("XDG_CACHE_HOME")
    try:
        caches = Path(folder) if folder else Path.home() / ".cache"
    except RuntimeError:
        caches = Path(tempfile.gettempdir()) / f"cache-{os.getuid()}"
    return caches / "handover_marl" / kind


def get_cache_path(kind: str, urdf: Path, *parameters: bytes) -> Path:
    """Return the path of the cache file of a kind for an object model.

    The file name has a hash of the object's collision shapes and of all other inputs, the parameters.
    """
    digest = hashlib.sha256(b"".join(parameters))
    for path in (urdf, *list_mesh_files(urdf, "collision")):
        digest.update(read_plain_file(path))
    return get_cache_folder(kind) / f"{urdf.parent.name}-{digest.hexdigest()[:16]}.npz"


def load_cached_arrays(path: Path, names: Sequence[str], what: str) -> Arrays | None:
    """Load arrays by name from a cache file; None if it is missing, and with a warning if it cannot be read."""
    try:
        return read_arrays(path, tuple(names)) if path.exists() else None
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("%s: %s cannot be read (%s); computing it again", path, what, error)
        return None


def save_cached_arrays(path: Path, arrays: Arrays, what: str) -> None:
    """Write arrays to a cache file; log a warning, with a description of them, if that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, arrays)
    except (OSError, HandoverError):
        _log.warning("%s %s not saved: cannot write to that folder; it is computed again each time", what, path)
