"""Signed distance fields (SDFs) on voxel grids, and a cache of the fields of object models."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.array_cache import Arrays, get_cache_path, load_cached_arrays, save_cached_arrays
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.model_files.urdf import read_model_mtimes

Floats = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

#: Distance (m) that is assumed at points outside the grid, larger than any padding of a planner.
OUTSIDE_DISTANCE = 1.0
#: Folder of the cached fields within the user's cache folder.
CACHE_KIND = "distance_fields"
# Grid spacing of the cached fields (m).
_CELL = 0.006
# Increased when the computation changes, so that cached fields of older versions are not used.
_VERSION = 1


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distance field of a closed surface on a regular grid; negative inside.

    Attributes:
        values: (nx, ny, nz) float32 distances at the grid's nodes (m).
        lower: (3,) position of the first node in the surface's frame (m).
        cell: Spacing of the nodes (m).
    """

    values: Floats
    lower: Array
    cell: float

    def compute_distances(self, points: Floats) -> Floats:
        """Return distances (n,) in m at points (3, n) in m, surface frame: negative inside, 1 m outside the grid."""
        return self.compute_distances_and_gradients(points, with_gradients=False)[0]

    def compute_distances_and_gradients(self, points: Floats, with_gradients: bool = True) -> tuple[Floats, Floats]:
        """Interpolate signed distances (n,) in m and gradients (3, n) at points (3, n) in m in the surface's frame.

        Distances are negative inside. Points outside the grid get `OUTSIDE_DISTANCE`, 1 m, and a gradient of zero. If
        `with_gradients` is false, the gradients are an empty array (3, 0).
        """
        nodes = (points - self.lower.astype(np.float32)[:, None]) / np.float32(self.cell)
        highest = np.array(self.values.shape)[:, None] - 1
        inside = ((nodes >= 0.0) & (nodes < highest)).all(axis=0)
        distances = np.full(points.shape[1], OUTSIDE_DISTANCE, dtype=np.float32)
        gradients = np.zeros(points.shape if with_gradients else (3, 0), dtype=np.float32)
        if inside.any():
            nodes = nodes if inside.all() else nodes[:, inside]
            first = nodes.astype(np.int32)
            corners = self._get_corner_values(first)
            fraction = nodes - first
            distances[inside] = _interpolate_trilinear(corners, fraction)
            if with_gradients:
                gradients[:, inside] = _differentiate_trilinear(corners, fraction) / np.float32(self.cell)
        return distances, gradients

    def _get_corner_values(self, first: npt.NDArray[np.int32]) -> Floats:
        """Return distances (2, 2, 2, n) in m at the corners of n cells, given the grid indices (3, n) of the lowest."""
        _, ny, nz = self.values.shape
        at = (first[0] * ny + first[1]) * nz + first[2]
        steps = (np.arange(2)[:, None, None] * ny + np.arange(2)[:, None]) * nz + np.arange(2)
        corners: Floats = self.values.reshape(-1)[steps[..., None] + at]
        return corners


def sample_distance_field(distance: Callable[[Array], Array], lower: Array, upper: Array, cell: float) -> DistanceField:
    """Sample a signed distance function (m, negative inside) on a grid over a box.

    `distance` maps points (n, 3) to distances (n,). The grid of spacing `cell` covers `lower` (3,) to `upper` (3,) (m).
    """
    counts = np.ceil((upper - lower) / cell).astype(int) + 1
    axes = [start + cell * np.arange(count) for start, count in zip(lower, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return DistanceField(distance(nodes).astype(np.float32).reshape(counts), np.array(lower), cell)


def _interpolate_trilinear(corners: Floats, fraction: Floats) -> Floats:
    for part in fraction:
        corners = corners[0] + (corners[1] - corners[0]) * part
    return corners


def _differentiate_trilinear(corners: Floats, fraction: Floats) -> Floats:
    gradient = []
    for axis in range(3):
        along = np.moveaxis(corners, axis, 0)
        gradient.append(_interpolate_trilinear(along[1] - along[0], np.delete(fraction, axis, axis=0)))
    return np.stack(gradient)


@cached_by_file(32, read_model_mtimes)
def load_object_sdf(urdf: Path, margin: float) -> DistanceField:
    """Load the signed distance field of an object's collision shapes from the cache, or compute and cache it.

    The field is in the frame of the shapes' link. The shapes may overlap and have holes. The grid extends `margin` (m)
    beyond them. Computing a field needs libigl (extra `planning`).
    """
    path = get_cache_path(CACHE_KIND, urdf, f"{_VERSION} {_CELL} {margin}".encode())
    arrays = load_cached_arrays(path, ("values", "lower", "cell"), "distance field")
    if arrays is not None:
        return DistanceField(arrays["values"], arrays["lower"], float(arrays["cell"]))
    # Imported here, since it belongs to the extra `planning`.
    import igl

    vertices, faces = read_collision_mesh(urdf)

    def compute_distances(points: Array) -> Array:
        # The winding number gives the right sign for overlapping components and meshes with holes.
        found = igl.signed_distance(points, vertices, faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER)[0]
        return np.asarray(found, dtype=np.float64)

    field = sample_distance_field(
        compute_distances, vertices.min(axis=0) - margin, vertices.max(axis=0) + margin, _CELL
    )
    content: Arrays = {"values": field.values, "lower": field.lower, "cell": np.array(field.cell)}
    save_cached_arrays(path, content, "distance field")
    return field
