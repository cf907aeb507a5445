"""Convex hulls with few corners, which simulators are quick with."""

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]


def extreme_points(points: Array, limit: int) -> Array:
    """Of many points (n, 3), at most `limit`: those that reach furthest along evenly spread directions."""
    for count in range(4 * limit, limit - 1, -1):
        k = np.arange(count) + 0.5
        height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
        radius = np.sqrt(1.0 - height**2)
        directions = np.column_stack([radius * np.cos(turn), height, radius * np.sin(turn)])
        chosen = np.unique(np.argmax(points @ directions.T, axis=0))
        if len(chosen) <= limit:
            break
    return np.asarray(points[chosen])


def hull(points: Array) -> tuple[Array, Faces]:
    """The convex hull of points (n, 3): its corners (v, 3) and triangles (f, 3), wound outwards.

    Raises:
        scipy.spatial.QhullError: The points lie in a plane.
    """
    found = ConvexHull(points)
    corners = np.sort(found.vertices)
    faces = np.searchsorted(corners, found.simplices)
    kept = points[corners]
    normals = np.cross(kept[faces[:, 1]] - kept[faces[:, 0]], kept[faces[:, 2]] - kept[faces[:, 0]])
    inwards = np.einsum("fi,fi->f", normals, found.equations[:, :3]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return kept, faces
