"""Reading OBJ files: the triangles of each of their objects."""

import itertools
import re
import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

# The first number of every corner of a face: that of its vertex.
_CORNERS = re.compile(r"(?:^|\s)(-?[0-9]{1,9})(?=[/\s]|$)")


@dataclass(frozen=True, eq=False)
class ObjFile:
    """What an OBJ file holds.

    Attributes:
        vertices: (v, 3) in m, all of the file's.
        groups: (f, 3) numbers of the corners of each object's triangles; polygons are cut into fans.
    """

    vertices: Array
    groups: tuple[Faces, ...]

    @property
    def faces(self) -> Faces:
        """(f, 3) of all objects together."""
        return np.concatenate(self.groups)


def read_obj(path: Path) -> ObjFile:
    """Read an OBJ file.

    Raises:
        DataFormatError: It cannot be read, has no triangle, a number that is not finite, or a corner that is not there.
    """
    vertices: list[list[float]] = []
    groups: list[list[tuple[int, int, int]]] = [[]]
    try:
        for line in path.read_text(errors="replace").splitlines():
            kind, _, rest = line.strip().partition(" ")
            if kind == "v":
                vertices.append([float(word) for word in rest.split()[:3]])
            elif kind in ("o", "g") and groups[-1]:
                groups.append([])
            elif kind == "f":
                corners = [_corner(word, len(vertices)) for word in rest.split()]
                groups[-1] += [(corners[0], *pair) for pair in itertools.pairwise(corners[1:])]
        points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
        found = tuple(np.array(faces, dtype=np.int64).reshape(-1, 3) for faces in groups if faces)
    except (OSError, ValueError, IndexError) as error:
        raise DataFormatError(f"{path}: not an OBJ file of triangles ({error}); check the file") from error
    if not found:
        raise DataFormatError(f"{path}: the mesh is empty; check the file")
    # Corners may be named before they come, so only now is it known which there are.
    corners_named = np.concatenate(found)
    if corners_named.min() < 0 or corners_named.max() >= len(points):
        raise DataFormatError(f"{path}: a face names a corner that is not there; check the file")
    if not np.isfinite(points).all():
        raise DataFormatError(f"{path}: a vertex is not finite; check the file")
    return ObjFile(points, found)


def check_obj(path: Path) -> None:
    """Look, quickly, whether an OBJ file can be handed to a simulator that trusts it.

    Raises:
        DataFormatError: It cannot be read, or names corners that are not there.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataFormatError(f"{path}: not a plain file; check the model")
        lines = path.read_text(errors="replace").splitlines()
    except OSError as error:
        raise DataFormatError(f"{path}: cannot read this mesh ({error.strerror or error})") from error
    count = sum(line.startswith(("v ", "v\t")) for line in lines)
    faces = " ".join(line[2:] for line in lines if line.startswith(("f ", "f\t")))
    corners = np.array([int(number) for number in _CORNERS.findall(faces)], dtype=np.int64)
    if len(corners) and (corners.max() > count or corners.min() < -count or not corners.all()):
        raise DataFormatError(f"{path}: a face names a corner that is not there; check the file")


def _corner(word: str, known: int) -> int:
    """Number from 0 of a face's corner, which OBJ counts from 1, or back from the last one."""
    number = int(word.partition("/")[0])
    return number - 1 if number > 0 else known + number if number < 0 else -1
