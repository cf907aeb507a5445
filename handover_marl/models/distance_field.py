"""Signed distances on a voxel grid, looked up between its cells."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

Floats = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

#: Value beyond a grid (m): farther than any padding.
FAR = 1.0


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances to a surface, negative inside it.

    Attributes:
        values: (x, y, z) float32 distances at the grid's nodes (m).
        lower: (3,) place of the first node in the surface's frame (m).
        cell: Distance of neighbouring nodes (m).
    """

    values: Floats
    lower: Array
    cell: float

    def distances(self, points: Floats) -> Floats:
        """(n,) distances (m) of points (3, n) by trilinear interpolation; FAR beyond the grid."""
        return self._interpolated(points, slopes=False)[0]

    def distances_and_slopes(self, points: Floats) -> tuple[Floats, Floats]:
        """(n,) distances (m) of points (3, n), and (3, n) their gradients; FAR and zero beyond the grid."""
        return self._interpolated(points, slopes=True)

    def clamped(self, points: Array) -> Array:
        """Distances (...) in m at points (..., 3) by trilinear interpolation, as at the edge beyond the grid."""
        nodes = (points.reshape(-1, 3) - self.lower).T / self.cell
        found = map_coordinates(self.values, nodes, order=1, mode="nearest", output=np.float64)
        return np.asarray(found.reshape(points.shape[:-1]))

    def outward(self, points: Array) -> Array:
        """Unit vectors (..., 3) away from the surface, by central differences."""
        h = self.cell
        slopes = np.stack([self.clamped(points + h * e) - self.clamped(points - h * e) for e in np.eye(3)], axis=-1)
        return np.asarray(slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-12))

    def mirrored(self) -> "DistanceField":
        """The field of the surface mirrored in x."""
        far = self.lower[0] + self.cell * (self.values.shape[0] - 1)
        return DistanceField(self.values[::-1], np.array([-far, *self.lower[1:]]), self.cell)

    def _interpolated(self, points: Floats, slopes: bool) -> tuple[Floats, Floats]:
        nodes = (points - self.lower.astype(np.float32)[:, None]) / np.float32(self.cell)
        highest = np.array(self.values.shape)[:, None] - 1
        inside = ((nodes >= 0.0) & (nodes < highest)).all(axis=0)
        distances = np.full(points.shape[1], FAR, dtype=np.float32)
        gradients = np.zeros(points.shape if slopes else (3, 0), dtype=np.float32)
        if inside.any():
            nodes = nodes if inside.all() else nodes[:, inside]
            first = nodes.astype(np.int32)
            corners = self._corners(first)
            share = nodes - first
            distances[inside] = _trilinear(corners, share)
            if slopes:
                gradients[:, inside] = _slopes(corners, share) / np.float32(self.cell)
        return distances, gradients

    def _corners(self, first: npt.NDArray[np.int32]) -> Floats:
        """(2, 2, 2, n) values of the nodes around points."""
        _, ny, nz = self.values.shape
        at = (first[0] * ny + first[1]) * nz + first[2]
        flat = self.values.reshape(-1)
        steps = (np.arange(2)[:, None, None] * ny + np.arange(2)[:, None]) * nz + np.arange(2)
        corners: Floats = flat[steps[..., None] + at]
        return corners


def mesh_field(vertices: Array, faces: npt.NDArray[np.int64], margin: float, cell: float) -> DistanceField:
    """The field of a mesh, reaching `margin` (m) beyond it. Needs libigl.

    Args:
        vertices: (v, 3) in m.
        faces: (f, 3) corners of its triangles; parts may overlap, and have holes.
        margin: How far beyond the mesh the grid reaches (m).
        cell: Distance of nodes (m).
    """
    import igl

    def distance(points: Array) -> Array:
        # The winding number tells inside from outside for parts that overlap and for holes alike.
        found = igl.signed_distance(points, vertices, faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER)[0]
        return np.asarray(found, dtype=np.float64)

    return field_of(distance, vertices.min(axis=0) - margin, vertices.max(axis=0) + margin, cell)


def field_of(distance: Callable[[Array], Array], lower: Array, upper: Array, cell: float) -> DistanceField:
    """A field on a grid over a box.

    Args:
        distance: Gives (n,) distances (m) for points (n, 3).
        lower: Lowest corner (m).
        upper: Highest corner (m).
        cell: Distance of nodes (m).
    """
    counts = np.ceil((upper - lower) / cell).astype(int) + 1
    axes = [start + cell * np.arange(count) for start, count in zip(lower, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return DistanceField(distance(nodes).astype(np.float32).reshape(counts), np.array(lower), cell)


def _trilinear(corners: Floats, share: Floats) -> Floats:
    along = corners
    for part in share:
        along = along[0] + (along[1] - along[0]) * part
    return along


def _slopes(corners: Floats, share: Floats) -> Floats:
    slopes = []
    for axis in range(3):
        along = np.moveaxis(corners, axis, 0)
        along = along[1] - along[0]
        for part in np.delete(share, axis, axis=0):
            along = along[0] + (along[1] - along[0]) * part
        slopes.append(along)
    return np.stack(slopes)
