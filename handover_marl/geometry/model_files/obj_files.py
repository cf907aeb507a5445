"""Reader and writer of OBJ mesh files."""

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.execution.reading import read_plain_file, report_damage

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

# A byte order mark, a comment behind a face, lines joined by a backslash, and carriage returns alone: PyBullet drops a
# vertex or the whole mesh without an error.
_MISREAD_BY_BULLET = re.compile(rb"\A\xef\xbb\xbf|^[ \t]*f[ \t][^\r\n]*#|\\[ \t]*[\r\n]|\r(?!\n)", re.MULTILINE)
# Vertices count as lying in one plane if their smallest singular value is below this (m).
_FLAT = 1e-9
_LINE_END, _CONTINUATION, _COMMENT = (
    re.compile(r"\r\n|\r|\n"),
    re.compile(r"\\[ \t]*(\r\n|\r|\n)"),
    re.compile(r"#[^\r\n]*"),
)


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

    Vertex numbers may count back from the last vertex before the face. Normals, texture coordinates, colors and
    curves are ignored. An invalid or empty file raises `DataFormatError`.
    """
    with report_damage(path, "OBJ file of triangles", "check the file"):
        return _parse_obj(path, split_obj_lines(read_plain_file(path)))


def split_obj_lines(content: bytes) -> Iterator[list[str]]:
    """Return the words of each line of an OBJ file that is neither empty nor a comment; a backslash joins lines."""
    text = content.decode("utf-8-sig", errors="replace")
    if "\\" in text:
        text = _CONTINUATION.sub(" ", text)
    if "#" in text:
        text = _COMMENT.sub("", text)
    return filter(None, map(str.split, _LINE_END.split(text)))


def _parse_obj(path: Path, lines: Iterator[list[str]]) -> ObjMesh:
    vertices: list[tuple[float, float, float]] = []
    groups: list[list[tuple[int, int, int]]] = [[]]
    for words in lines:
        kind = words[0]
        if kind == "v":
            if len(words) < 4:
                raise ValueError(f"a vertex must be three numbers, got {' '.join(words)[:40]!r}")
            vertices.append((float(words[1]), float(words[2]), float(words[3])))
        elif kind == "f":
            if len(words) < 4:
                raise DataFormatError(f"{path}: a face must have at least three corners; the file may be incomplete")
            groups[-1] += split_polygon(words[1:], 0, len(vertices))
        elif kind in ("o", "g") and groups[-1]:
            groups.append([])
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    found = tuple(np.array(group, dtype=np.int64).reshape(-1, 3) for group in groups if group)
    if not found:
        raise DataFormatError(f"{path}: the mesh is empty; check the file")
    # Checked at the end: faces may precede their vertices.
    faces = np.concatenate(found)
    if faces.min() < 0 or faces.max() >= len(points):
        raise DataFormatError(f"{path}: a face names a corner that is not there; check the file")
    if not np.isfinite(points).all():
        raise DataFormatError(f"{path}: a vertex is not finite; check the file")
    return ObjMesh(points, found, faces)


def split_polygon(words: Sequence[str], part: int, count: int) -> list[tuple[int, int, int]]:
    """Split a face into triangles, each as three indices of vertices (part 0) or of texture coordinates (part 1).

    `words` are the face's corners in the file, e.g. "7/3" for vertex 7 and texture coordinate 3. Numbers in the file
    count from 1, or, if negative, backwards from the last of the `count` entries before the face. The returned indices
    count from 0; a missing number becomes -1.
    """
    numbers = [int((word.split("/")[part : part + 1] or [""])[0] or 0) for word in words]
    first, *others = [n - 1 if n > 0 else count + n if n < 0 else -1 for n in numbers]
    return [(first, *pair) for pair in itertools.pairwise(others)]


def format_obj(vertices: Array, faces: Faces, first: int = 1) -> str:
    """Return a mesh as OBJ text with 6 decimals, as in HandoverSim's files; the text numbers vertices from `first`."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (faces + first).tolist()]
    return "".join(lines)


def format_convex_parts(parts: Iterable[tuple[Array, Faces]]) -> str:
    """Return an OBJ text with one object for each convex mesh (vertices, faces), which PyBullet loads as one hull."""
    texts, first = [], 1
    for number, (vertices, faces) in enumerate(parts):
        texts.append(f"o convex_{number}\n{format_obj(vertices, faces, first)}")
        first += len(vertices)
    return "".join(texts)


def check_mesh(path: Path, solid: bool = False) -> None:
    """Raise `DataFormatError` if not every engine can load a mesh file; only the content of OBJ files is checked.

    PyBullet crashes on vertex numbers out of range, loads empty meshes without an error, and reads some forms of the
    format wrong. The vertices of a `solid` mesh must not all be in one plane.
    """
    if path.suffix.lower() != ".obj":
        return
    vertices = read_obj(path).vertices
    if _MISREAD_BY_BULLET.search(read_plain_file(path)):
        raise DataFormatError(
            f"{path}: must not have a byte order mark, a comment behind a face, lines joined by a backslash or a "
            "carriage return alone, which PyBullet does not read; change it"
        )
    if solid and np.linalg.matrix_rank(vertices - vertices[0], tol=_FLAT) < 3:
        raise DataFormatError(f"{path}: all vertices are in one plane; check the file")
