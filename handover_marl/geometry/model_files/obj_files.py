"""Reader and writer of OBJ mesh files."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.execution.reading import cached_by_file, read_plain_file, report_damage

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
        groups: One (f, 3) array per object (line `o` or `g`): indices in `vertices` of its triangles' corners.
        faces: (f, 3) indices in `vertices` of the corners of all triangles; polygons are split into fans.
    """

    vertices: Array
    groups: tuple[Faces, ...]
    faces: Faces


@cached_by_file(maxsize=128)
def read_obj(path: Path) -> ObjMesh:
    """Read vertices and triangles of an OBJ mesh file.

    Negative vertex numbers count back from the last vertex before the face. Normals, texture coordinates, colors and
    curves are ignored. An invalid or empty file raises `DataFormatError`.
    """
    with report_damage(path, "OBJ file of triangles", "check the file"):
        return _parse_obj(path, split_obj_lines(read_plain_file(path)))


def split_obj_lines(content: bytes) -> Iterator[list[str]]:
    """Return the words of each line of an OBJ file's content, without comments and empty lines.

    A line that ends with a backslash continues in the next line.
    """
    text = content.decode("utf-8-sig", errors="replace")
    if "\\" in text:
        text = _CONTINUATION.sub(" ", text)
    if "#" in text:
        text = _COMMENT.sub("", text)
    return filter(None, map(str.split, _LINE_END.split(text)))


def _parse_obj(path: Path, lines: Iterator[list[str]]) -> ObjMesh:
    vertices: list[tuple[float, float, float]] = []
    polygons, counts, starts = list[list[str]](), list[int](), list[int]()
    for words in lines:
        kind = words[0]
        if kind == "v":
            if len(words) < 4:
                raise ValueError(f"a vertex must be three numbers, got {' '.join(words)[:40]!r}")
            vertices.append((float(words[1]), float(words[2]), float(words[3])))
        elif kind == "f":
            if len(words) < 4:
                raise DataFormatError(f"{path}: a face must have at least three corners; the file may be incomplete")
            polygons.append(words[1:])
            counts.append(len(vertices))
        elif kind in ("o", "g"):
            starts.append(len(polygons))
    if not polygons:
        raise DataFormatError(f"{path}: the mesh is empty; check the file")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    # Checked at the end: faces may precede their vertices.
    faces, owners = split_polygons(polygons, 0, counts)
    if faces.min() < 0 or faces.max() >= len(points):
        raise DataFormatError(f"{path}: a face names a corner that is not there; check the file")
    if not np.isfinite(points).all():
        raise DataFormatError(f"{path}: a vertex is not finite; check the file")
    points.flags.writeable = faces.flags.writeable = False  # `read_obj` keeps them
    groups = np.split(faces, np.searchsorted(owners, starts))
    return ObjMesh(points, tuple(group for group in groups if len(group)), faces)


def split_polygons(
    polygons: Sequence[Sequence[str]], part: int, counts: Sequence[int]
) -> tuple[Faces, npt.NDArray[np.int64]]:
    """Split polygons into fans of triangles, with indices of vertices (`part` 0) or texture coordinates (`part` 1).

    A corner is written as in the file: "7/3" has vertex 7 and texture coordinate 3. Positive numbers count from 1,
    negative ones back from the last entry before the polygon; `counts` are the numbers of entries before each polygon.

    Returns:
        Indices (f, 3) of the triangles' corners, from 0, -1 if missing; and the polygon's index (f,) of each triangle.
    """
    numbers = np.array([int(f"{word}//".split("/", 2)[part] or 0) for words in polygons for word in words])
    sizes = np.array(list(map(len, polygons)))
    indices = np.where(numbers > 0, numbers - 1, np.where(numbers < 0, np.repeat(counts, sizes) + numbers, -1))
    owners = np.repeat(np.arange(len(polygons)), sizes - 2)
    first, first_triangle = (np.cumsum(lengths) - lengths for lengths in (sizes, sizes - 2))
    step = np.arange(len(owners)) - first_triangle[owners]
    corners = first[owners, None] + np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    return indices[corners], owners


def format_obj(vertices: Array, faces: Faces, first: int = 1) -> str:
    """Return a mesh as OBJ text with 6 decimals, as in HandoverSim's files; the text numbers vertices from `first`."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (faces + first).tolist()]
    return "".join(lines)


def format_convex_parts(parts: Iterable[tuple[Array, Faces]]) -> str:
    """Return an OBJ text with an object for each convex mesh (vertices, faces); PyBullet loads each as one hull."""
    texts, first = [], 1
    for number, (vertices, faces) in enumerate(parts):
        texts.append(f"o convex_{number}\n{format_obj(vertices, faces, first)}")
        first += len(vertices)
    return "".join(texts)


def check_mesh(path: Path, solid: bool = False) -> None:
    """Raise `DataFormatError` for an OBJ file that a physics engine cannot load correctly; ignore other mesh files.

    PyBullet crashes on vertex numbers out of range, loads empty meshes without an error, and reads some forms of the
    format wrong. With `solid`, the vertices must not all be in one plane, either.
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
