"""Models' collision shapes as MuJoCo takes them: convex parts, and the inertia that Bullet gives them."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import DataFormatError
from handover_marl.models.kinematic_tree import KinematicTree, Sphere
from handover_marl.models.obj_files import read_obj
from handover_marl.models.poses import IDENTITY, compose_point
from handover_marl.models.urdf_links import UrdfLink
from handover_marl.models.urdf_shapes import UrdfShape, read_urdf_shapes

Array = npt.NDArray[np.float64]

# By so much (m) the box from which Bullet works out a link's inertia is larger on each side than its hulls: their
# margin and twice that of the shape that holds them. A hull with a place of its own in the link is held by one more.
_AROUND_HULL, _AROUND_PLACED = 0.003, 0.001


@dataclass(frozen=True, eq=False)
class Part:
    """One convex part of a link.

    Attributes:
        kind: "hull", "box" or "sphere".
        vertices: (v, 3) of a hull, in the shape's frame (m); else none.
        size: Sides of a box (m), or radius of a sphere (m); of a hull none.
        link_from_part: (7,) its pose in the link's frame.
    """

    kind: str
    vertices: Array
    size: tuple[float, ...]
    link_from_part: Array

    def corners(self) -> Array:
        """(n, 3) points in the part's frame whose box is the part's (m)."""
        if self.kind == "hull":
            return self.vertices
        half = np.array(self.size) / 2.0 if self.kind == "box" else np.full(3, self.size[0])
        return np.array([-half, half])


def convex_parts(shapes: Sequence[UrdfShape]) -> list[Part]:
    """What Bullet makes of shapes: a hull around each object of a mesh file.

    Raises:
        DataFormatError: A mesh file cannot be read.
    """
    return [part for shape in shapes for part in _parts(shape, _changed(shape.mesh))]


def _changed(mesh: Path | None) -> int:
    return mesh.stat().st_mtime_ns if mesh is not None and mesh.exists() else 0


# Shapes of a file that was not changed are the same ones each time, and so are their parts: many scenes share them.
@functools.lru_cache(maxsize=2048)
def _parts(shape: UrdfShape, changed: int) -> tuple[Part, ...]:
    if shape.mesh is None:
        return (Part(shape.kind, np.zeros((0, 3)), shape.size, shape.link_from_shape),)
    found = _objects(shape.mesh, changed)
    return tuple(Part("hull", vertices * shape.size, (), shape.link_from_shape) for vertices in found)


@functools.lru_cache(maxsize=512)
def _objects(mesh: Path, changed: int) -> tuple[Array, ...]:
    """Vertices (v, 3) of each object in a file, each once."""
    if mesh.suffix.lower() == ".obj":
        content = read_obj(mesh)
        return tuple(np.unique(content.vertices[np.unique(faces)], axis=0) for faces in content.groups)
    return (np.unique(_stl_corners(mesh), axis=0),)


def _stl_corners(mesh: Path) -> Array:
    """Corners (n, 3) of a binary STL file's triangles."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")])
    try:
        content = mesh.read_bytes()
        count = int(np.frombuffer(content, "<u4", 1, 80)[0])
        triangles = np.frombuffer(content, record, count, 84)
    except (OSError, ValueError) as error:
        raise DataFormatError(f"{mesh}: neither an OBJ nor a binary STL file ({error}); check the file") from error
    return np.asarray(triangles["corners"].reshape(-1, 3), dtype=np.float64)


def box_inertia(link: UrdfLink, parts: Sequence[Part]) -> Array:
    """(3,) moments of inertia (kg m^2) that Bullet gives a link: those of a box of its size about its centre of mass.

    Args:
        link: Its mass, and where its centre is.
        parts: All of its shapes.
    """
    lowers, uppers = zip(*(_bounds(part, any(link.center)) for part in parts), strict=True)
    x, y, z = (np.max(uppers, axis=0) - np.min(lowers, axis=0)) ** 2
    return np.array([y + z, x + z, x + y]) * link.mass / 12.0


def link_balls(urdf: Path, tree: KinematicTree) -> dict[int, Sphere]:
    """A ball around the collision shapes of every link that has some; -1 is the base.

    Raises:
        SimulationError, DataFormatError: The model or one of its meshes cannot be read.
    """
    shapes = read_urdf_shapes(urdf, tree, "collision")
    balls = {}
    for link in sorted({shape.link for shape in shapes}):
        parts = convex_parts([shape for shape in shapes if shape.link == link])
        lowers, uppers = zip(*(_bounds(part, False) for part in parts), strict=True)
        lower, upper = np.min(lowers, axis=0), np.max(uppers, axis=0)
        balls[link] = Sphere((lower + upper) / 2.0, float(np.linalg.norm(upper - lower)) / 2.0)
    return balls


@functools.lru_cache(maxsize=4096)
def _bounds(part: Part, moved: bool) -> tuple[Array, Array]:
    """Corners of the box around a part in the link's frame, as Bullet works it out: a turned box grows."""
    corners = part.corners()
    around = 0.0
    if part.kind == "hull":
        around = _AROUND_HULL + (_AROUND_PLACED if moved or not np.array_equal(part.link_from_part, IDENTITY) else 0.0)
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    turn = np.abs(Rotation.from_quat(part.link_from_part[3:]).as_matrix())
    middle = compose_point(part.link_from_part, (lower + upper) / 2.0)
    half = turn @ ((upper - lower) / 2.0) + around
    return middle - half, middle + half
