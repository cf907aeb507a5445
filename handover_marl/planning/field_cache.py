"""Distance fields of object models, made once and kept in the user's cache folder.

Needs libigl and trimesh besides what `array_cache` needs (extra `planning`).
"""

import functools
import logging
from pathlib import Path

import numpy as np

from handover_marl.models.distance_field import DistanceField, mesh_field
from handover_marl.models.meshes import model_triangles
from handover_marl.planning.array_cache import Arrays, cache_file, keep, read_kept

#: Folder of the fields within the user's cache folder.
KIND = "distance_fields"
CELL = 0.006  # m
# Changes when fields of the same model come out otherwise.
_VERSION = 1

_log = logging.getLogger(__name__)


def object_field(urdf: Path, margin: float) -> DistanceField:
    """The field of an object's collision shapes in its own frame, reaching `margin` (m) beyond them.

    Raises:
        DataFormatError: The model or a mesh cannot be read.
    """
    return _field(urdf, urdf.stat().st_mtime_ns, margin)


@functools.lru_cache(maxsize=32)
def _field(urdf: Path, changed: int, margin: float) -> DistanceField:
    path = cache_file(KIND, urdf, f"{_VERSION} {CELL} {margin}".encode())
    kept = _read(path)
    if kept is not None:
        return kept
    field = mesh_field(*model_triangles(urdf), margin, CELL)
    arrays: Arrays = {"values": field.values, "lower": field.lower, "cell": np.array(field.cell)}
    keep(path, arrays, "distance field")
    return field


def _read(path: Path) -> DistanceField | None:
    kept = read_kept(path, ("values", "lower", "cell"), "distance field")
    if kept is None:
        return None
    values, lower, cell = kept["values"], kept["lower"], kept["cell"]
    if values.ndim != 3 or values.dtype != np.float32 or lower.shape != (3,) or cell.shape != ():
        _log.warning("%s: no distance field; making it anew", path)
        return None
    return DistanceField(values, lower, float(cell))
