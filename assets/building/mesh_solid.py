"""Object of a triangle mesh in the form that grasps are drawn for."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.assets.building.object_files import merge_meshes, read_parts
from handover_marl.assets.object_models import VISUAL_NAME
from handover_marl.datasets.synthetic.random_stream import RandomStream
from handover_marl.geometry.distance_field import DistanceField, load_object_sdf

Array = npt.NDArray[np.float64]

_MARGIN, _CELL = 0.05, 0.003  # m, of the distance field
_STEP = 1e-5  # m
_MIN_WIDTH = 0.002  # m


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
    return MeshSolid(surface, load_object_sdf(urdf, _MARGIN, _CELL))
