"""OBJ files of objects, the palette image that colors them, and meshes in the form that grasps are drawn for."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.assets.object_models import (
    PALETTE,
    VISUAL_NAME,
    format_visual,
)
from handover_marl.datasets.synthetic.random_stream import RandomStream
from handover_marl.geometry.distance_field import DistanceField, load_object_sdf
from handover_marl.geometry.model_files.meshes import concatenate_meshes
from handover_marl.geometry.model_files.obj_files import format_convex_parts, read_obj

_CELL = 4  # pixels; texture interpolation at the center stays inside of the cell
Array = npt.NDArray[np.float64]
_FIELD_MARGIN, _FIELD_CELL = 0.05, 0.003  # m
_STEP = 1e-5  # m
_MIN_WIDTH = 0.002  # m


def make_palette_image() -> npt.NDArray[np.uint8]:
    """Return the image (4, 4 * n, 3) with one square cell per color, in alphabetical order."""
    colors = np.array([PALETTE[name] for name in sorted(PALETTE)], dtype=np.uint8)
    return np.repeat(np.repeat(colors[None], _CELL, axis=0), _CELL, axis=1)


def write_palette(folder: Path) -> None:
    """Write `palette.png` and the material file `palette.mtl` to a folder."""
    from PIL import Image

    # Not compressed: compressors of other versions write other bytes.
    Image.fromarray(make_palette_image()).save(folder / "palette.png", compress_level=0)
    (folder / "palette.mtl").write_text("newmtl palette\nKa 1 1 1\nKd 1 1 1\nmap_Kd palette.png\n", newline="\n")


def write_visual(path: Path, colored_meshes: Iterable[tuple[str, trimesh.Trimesh]]) -> None:
    """Write colored meshes (m) as one OBJ file next to the palette."""
    path.write_text(format_visual((color, *_canonicalize(mesh)) for color, mesh in colored_meshes), newline="\n")


def write_convex_parts(path: Path, parts: Sequence[trimesh.Trimesh]) -> None:
    """Write convex meshes (m) as the objects of one OBJ file."""
    path.write_text(format_convex_parts(map(_canonicalize, parts)), newline="\n")


def _canonicalize(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return rounded vertices and faces in an order that depends only on the shape."""
    # Adding zero turns -0.0 into 0.0.
    rounded = np.round(np.asarray(mesh.vertices, dtype=np.float64), 6) + 0.0
    vertices, renumbered = np.unique(rounded, axis=0, return_inverse=True)
    faces = renumbered.reshape(-1)[np.asarray(mesh.faces)]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[whole]
    turned = np.stack([np.roll(face, -int(np.argmin(face))) for face in faces])
    return vertices, turned[np.lexsort(turned.T[::-1])]


def read_parts(path: Path) -> list[trimesh.Trimesh]:
    """Read the meshes (m) of an OBJ file, one for each of its objects.

    Raises:
        DataFormatError: The file is not an OBJ file of triangles.
    """
    content = read_obj(path)
    return [_extract_submesh(content.vertices, faces) for faces in content.groups]


def merge_meshes(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return one mesh of the vertices and faces of all meshes."""
    vertices, faces = concatenate_meshes([(mesh.vertices, mesh.faces) for mesh in meshes])
    return trimesh.Trimesh(vertices, faces, process=False)


def _extract_submesh(points: npt.NDArray[np.float64], faces: npt.NDArray[np.int64]) -> trimesh.Trimesh:
    used, compact = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(points[used], compact.reshape(-1, 3), process=False)


class MeshSolid:
    """Object of a surface and of the signed distance field of its collision shapes, in its frame (m).

    Args:
        surface: Triangle mesh, which may have open or overlapping parts.
        field: Distance field.
    """

    def __init__(self, surface: trimesh.Trimesh, field: DistanceField) -> None:
        self._surface, self._field = surface, field

    @property
    def corners(self) -> Array:
        """Vertices (n, 3) of the surface (m)."""
        return np.asarray(self._surface.vertices, dtype=np.float64)

    def mirror(self) -> "MeshSolid":
        """Return the object mirrored in x, as it is for the grasps of left hands."""
        faces = np.asarray(self._surface.faces)[:, ::-1]
        surface = trimesh.Trimesh(self.corners * [-1.0, 1.0, 1.0], faces, process=False)
        return MeshSolid(surface, self._field.mirror())

    def compute_distances(self, points: Array) -> Array:
        """Return signed distances (...) of points (..., 3), negative inside (m)."""
        return self._field.compute_clamped_distances(points)

    def compute_normals(self, points: Array) -> Array:
        """Return outward unit normals (..., 3) at points (..., 3) near the surface."""
        return self._field.compute_outward_normals(points)

    def sample_opposite_points(
        self, random: RandomStream, count: int, max_width: float, tilt: float
    ) -> tuple[Array, Array, Array]:
        """Sample pairs of opposite points; see `handover_marl.datasets.generated.shapes.Solid`."""
        mesh = self._surface
        points, faces = trimesh.sample.sample_surface(mesh, count, seed=random.integer(2**31))
        directions = tilt * random.normals(count, 3) - mesh.face_normals[faces]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        hits, rays, triangles = mesh.ray.intersects_location(points + _STEP * directions, directions)
        cosines = np.einsum("ni,ni->n", mesh.face_normals[triangles], directions[rays])
        widths = np.linalg.norm(hits - points[rays], axis=1)
        good = np.flatnonzero((cosines > 0.0) & (widths < max_width) & (widths > _MIN_WIDTH))
        # A ray through a cup leaves it twice, at its wall and at its far side; one of the places is taken at random.
        chosen = good[np.argsort(random.uniforms(len(good)))]
        chosen = chosen[np.unique(rays[chosen], return_index=True)[1]]
        return np.asarray(points[rays[chosen]]), np.asarray(hits[chosen]), np.asarray(cosines[chosen])


def load_mesh_solid(urdf: Path) -> MeshSolid:
    """Return the object of a URDF of the library or of a folder of custom scenes.

    Raises:
        DataFormatError: A file cannot be read.
    """
    surface = merge_meshes(read_parts(urdf.with_name(VISUAL_NAME)))
    return MeshSolid(surface, load_object_sdf(urdf, _FIELD_MARGIN, _FIELD_CELL))
