"""Reader and writer of OBJ mesh files, and safety check of mesh files."""

import itertools
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.execution.reading import MAX_FILE_BYTES, check_plain_file, read_plain_file

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

# Vertices count as lying in one plane if their smallest singular value is below this (m).
_FLAT = 1e-9
#: Largest accepted size of a material file (bytes).
MAX_MATERIAL_BYTES = 10_000_000
# Vertex number of every corner of a face, the first of the numbers between slashes.
_CORNERS = re.compile(r"(?:^|\s)(-?[0-9]{1,9})(?=[/\s]|$)")


@dataclass(frozen=True, eq=False)
class ObjMesh:
    """Vertices and triangles of an OBJ mesh file.

    Attributes:
        vertices: (v, 3) vertices of all objects in the file (m).
        groups: One (f, 3) array per object with the vertex numbers of its triangles; polygons are split into fans.
        faces: (f, 3) vertex numbers of the triangles of all objects.
    """

    vertices: Array
    groups: tuple[Faces, ...]
    faces: Faces


def read_obj(path: Path) -> ObjMesh:
    """Read vertices and triangles of an OBJ mesh file.

    Raises:
        DataFormatError: The file cannot be read, has no triangle, a vertex that is not finite, a face with fewer than
            three corners, or a face with a vertex number out of range.
    """
    vertices: list[list[float]] = []
    groups: list[list[tuple[int, int, int]]] = [[]]
    try:
        for line in _read_lines(path):
            kind, _, rest = line.strip().partition(" ")
            if kind == "v":
                vertices.append([float(word) for word in rest.split()[:3]])
            elif kind in ("o", "g") and groups[-1]:
                groups.append([])
            elif kind == "f":
                # Vertices count from 1, or backwards from -1, the last vertex before the face.
                numbers = [int(word.partition("/")[0]) for word in rest.split()]
                corners = [n - 1 if n > 0 else len(vertices) + n if n < 0 else -1 for n in numbers]
                if len(corners) < 3:
                    raise _make_face_error(path)
                groups[-1] += [(corners[0], *pair) for pair in itertools.pairwise(corners[1:])]
        points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
        found = tuple(np.array(group, dtype=np.int64).reshape(-1, 3) for group in groups if group)
    except (OSError, ValueError, IndexError) as error:
        raise DataFormatError(f"{path}: not an OBJ file of triangles ({error}); check the file") from error
    if not found:
        raise DataFormatError(f"{path}: the mesh is empty; check the file")
    # Checked at the end: faces may precede their vertices.
    faces = np.concatenate(found)
    if faces.min() < 0 or faces.max() >= len(points):
        raise DataFormatError(f"{path}: a face names a corner that is not there; check the file")
    if not np.isfinite(points).all():
        raise DataFormatError(f"{path}: a vertex is not finite; check the file")
    return ObjMesh(points, found, faces)


def format_obj(vertices: Array, faces: Faces, first: int = 1) -> str:
    """Return a mesh as Wavefront OBJ text with 6 decimals, as in HandoverSim's files.

    Args:
        vertices: (v, 3) vertices (m).
        faces: (f, 3) vertex indices, from 0.
        first: Number of the mesh's first vertex in the file; other meshes may precede it.
    """
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (faces + first).tolist()]
    return "".join(lines)


def check_mesh(path: Path, solid: bool = False) -> None:
    """Check quickly that a mesh file can be loaded; only the content of OBJ files is checked.

    PyBullet crashes on vertex numbers out of range, and loads empty meshes without an error.

    Args:
        path: Mesh file. Files of other formats than OBJ may be missing.
        solid: Whether to refuse meshes whose vertices all lie in one plane.

    Raises:
        DataFormatError: The file is not a plain file or is too large; or an OBJ file cannot be read, has no
            faces, a face with fewer than three corners, a vertex that is not finite, a vertex number out of
            range, or is flat.
    """
    if path.suffix.lower() != ".obj":
        _check_if_present(path)
        return
    try:
        lines = _read_lines(path)
    except (OSError, ValueError) as error:
        raise DataFormatError(f"{path}: cannot read this mesh ({error}); check the model") from error
    _check_materials(path.parent, lines)
    faces = [line[2:] for line in lines if line.startswith(("f ", "f\t"))]
    corners = np.array(_CORNERS.findall(" ".join(faces)), dtype=np.int64)
    try:
        vertices = np.array([line.split()[1:4] for line in lines if line.startswith(("v ", "v\t"))], dtype=np.float64)
    except ValueError as error:
        raise DataFormatError(f"{path}: a vertex must be three numbers ({error}); check the file") from error
    if not len(corners) or not len(vertices):
        raise DataFormatError(f"{path}: the mesh is empty; check the file")
    if any(len(face.split()) < 3 for face in faces):
        raise _make_face_error(path)
    if not np.isfinite(vertices).all():
        raise DataFormatError(f"{path}: a vertex is not finite; check the file")
    if corners.max() > len(vertices) or corners.min() < -len(vertices) or not corners.all():
        raise DataFormatError(f"{path}: a face names a corner that is not there; check the file")
    if solid and np.linalg.matrix_rank(vertices - vertices[0], tol=_FLAT) < 3:
        raise DataFormatError(f"{path}: all vertices are in one plane; check the file")


def _make_face_error(path: Path) -> DataFormatError:
    return DataFormatError(f"{path}: a face must have at least three corners; the file may be incomplete")


def _read_lines(path: Path) -> list[str]:
    return read_plain_file(path).decode(errors="replace").splitlines()


def _check_materials(folder: Path, lines: list[str]) -> None:
    """Check the material files and textures that lines of an OBJ file name; PyBullet opens them."""
    for name in {line[7:].strip() for line in lines if line.startswith(("mtllib ", "mtllib\t"))}:
        if name and _check_if_present(folder / name, MAX_MATERIAL_BYTES):
            material = read_plain_file(folder / name, MAX_MATERIAL_BYTES).decode(errors="replace")
            words = map(str.split, material.splitlines())
            for texture in {entry[-1] for entry in words if entry and entry[0].startswith("map_")}:
                _check_if_present(folder / texture)


def _check_if_present(path: Path, largest: int = MAX_FILE_BYTES) -> bool:
    """Return whether a path exists; raise `DataFormatError` if it is not a plain file or too large."""
    try:
        check_plain_file(path, largest)
    except FileNotFoundError:
        return False
    except (OSError, ValueError) as error:
        raise DataFormatError(f"{path}: cannot read this file of a mesh ({error}); check the model") from error
    return True
