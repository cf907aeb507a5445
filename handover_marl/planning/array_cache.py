"""What takes long to make of a model, kept as arrays in the user's cache folder.

Needs platformdirs (extra `planning`). Processes may share the folder: files appear whole, and one that cannot be read
is made anew.
"""

import hashlib
import logging
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import HandoverError
from handover_marl.files import write_arrays
from handover_marl.models.meshes import mesh_files

Arrays = dict[str, npt.NDArray[Any]]

_log = logging.getLogger(__name__)


def cache_folder(kind: str) -> Path:
    """Where things of a kind are kept: in the user's cache folder, which XDG_CACHE_HOME moves."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("handover_marl", appauthor=False)) / kind


def cache_file(kind: str, urdf: Path, *made_with: bytes) -> Path:
    """The file of what was made of an object's collision shapes, by their content and what else it was made with."""
    digest = hashlib.sha256(b"".join(made_with))
    for path in (urdf, *mesh_files(urdf, "collision")):
        digest.update(path.read_bytes())
    return cache_folder(kind) / f"{urdf.parent.name}-{digest.hexdigest()[:16]}.npz"


def read_kept(path: Path, names: Sequence[str], what: str) -> Arrays | None:
    """Arrays of a file, or None if it is not there or damaged.

    Args:
        path: The file.
        names: Arrays that it must have.
        what: What to call it in a warning.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("%s: no whole %s (%s); making it anew", path, what, error)
        return None


def keep(path: Path, arrays: Arrays, what: str) -> None:
    """Write arrays, or warn that it cannot be done; only the next start is slower for it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, arrays)
    except (OSError, HandoverError):
        _log.warning("%s %s not kept: cannot write to that folder; it is made anew each time", what, path)
