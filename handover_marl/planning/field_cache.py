"""Distance fields of object models, made once and kept in the user's cache folder.

Needs libigl, trimesh and platformdirs (extra `planning`). Processes may share the folder: files appear whole, and
one that cannot be read is made anew.
"""

import functools
import hashlib
import io
import logging
import zipfile
import zlib
from pathlib import Path

import numpy as np

from handover_marl.errors import HandoverError
from handover_marl.files import write_atomically
from handover_marl.models.distance_field import DistanceField, mesh_field
from handover_marl.models.meshes import mesh_files, model_triangles

CELL = 0.006  # m
# Changes when fields of the same model come out otherwise.
_VERSION = 1

_log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Where fields are kept: the user's cache folder, which XDG_CACHE_HOME moves."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("handover_marl", appauthor=False)) / "distance_fields"


def object_field(urdf: Path, margin: float) -> DistanceField:
    """The field of an object's collision shapes in its own frame, reaching `margin` (m) beyond them.

    Raises:
        DataFormatError: The model or a mesh cannot be read.
    """
    return _field(urdf, urdf.stat().st_mtime_ns, margin)


@functools.lru_cache(maxsize=32)
def _field(urdf: Path, changed: int, margin: float) -> DistanceField:
    path = cache_folder() / f"{urdf.parent.name}-{_fingerprint(urdf, margin)}.npz"
    kept = _read(path)
    if kept is not None:
        return kept
    field = mesh_field(*model_triangles(urdf), margin, CELL)
    _keep(path, field)
    return field


def _fingerprint(urdf: Path, margin: float) -> str:
    digest = hashlib.sha256(f"{_VERSION} {CELL} {margin}".encode())
    for path in (urdf, *mesh_files(urdf, "collision")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _read(path: Path) -> DistanceField | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as content:
            field = DistanceField(content["values"], content["lower"], float(content["cell"]))
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("%s: not a whole distance field (%s); making it anew", path, error)
        return None
    if field.values.ndim != 3 or field.values.dtype != np.float32 or field.lower.shape != (3,):
        _log.warning("%s: no distance field; making it anew", path)
        return None
    return field


def _keep(path: Path, field: DistanceField) -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, values=field.values, lower=field.lower, cell=field.cell)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, stream.getvalue())
    except (OSError, HandoverError):
        # Only the next start is slower for it.
        _log.warning("distance field %s not kept: cannot write to that folder; it is made anew each time", path)
