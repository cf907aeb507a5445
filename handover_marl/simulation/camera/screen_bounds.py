"""Screen-space bounds of mesh triangles, which select the pixels for ray casting.

Triangle vertices are in the camera's frame: x right, y down, z ahead (m). Pixels are numbered in image order.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.simulation.camera.optics import HALF_SIZE_PX, IMAGE_SIZE, NEAR, SAMPLE_OFFSET_PX

Array = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Boxes = npt.NDArray[np.int64]
#: Numbers of pixels in image order.
Pixels = npt.NDArray[np.int64]

# Added around boxes (pixels), larger than the rounding error of the projection.
_MARGIN = np.float32(0.01)
# Principal point, in pixel numbers.
_PRINCIPAL_POINT = np.array([HALF_SIZE_PX - SAMPLE_OFFSET_PX[0], HALF_SIZE_PX - SAMPLE_OFFSET_PX[1]], dtype=np.float32)


def find_candidate_pixels(points: Array, faces: npt.NDArray[np.int32]) -> Pixels:
    """Return the pixels in the bounding boxes of all triangles that face the camera.

    Pixels are in ascending order.

    Args:
        points: (v, 3) float32 vertices in the camera's frame (m).
        faces: (f, 3) vertex numbers, counterclockwise seen from outside.
    """
    is_behind = points[:, 2] < NEAR
    if not is_behind.any():
        return _find_covered_pixels(_bound_front_faces(project_points(points), faces))
    behind = is_behind[faces]
    is_any_behind = behind.any(axis=1)
    is_cut = is_any_behind & ~behind.all(axis=1)
    # Vertices behind the near plane get a valid depth; their positions are not used.
    positions = project_points(np.where(is_behind[:, None], np.float32(1.0), points))
    boxes = [_bound_front_faces(positions, faces[~is_any_behind])]
    if is_cut.any():
        boxes.append(_bound_polygons(*_clip_at_near_plane(points[faces[is_cut]], behind[is_cut])))
    return _find_covered_pixels(np.concatenate(boxes, axis=1))


def project_points(points: Array) -> Array:
    """Project points (..., 3) in front of the camera to fractional columns and rows (..., 2)."""
    positions: Array = _PRINCIPAL_POINT + np.float32(HALF_SIZE_PX) * points[..., :2] / points[..., 2:]
    return positions


def split_pixels_by_part(pixels: Pixels, parts: list[Array]) -> list[Pixels]:
    """Return for each part of a body the pixels in its bounding box.

    All pixels are returned for parts that reach the near plane.

    Args:
        pixels: Numbers of the pixels to select from.
        parts: (v, 3) vertices of each part in the camera's frame (m).
    """
    points = np.concatenate(parts)
    starts = np.cumsum([0, *map(len, parts[:-1])])
    is_cut = np.minimum.reduceat(points[:, 2], starts) < NEAR
    positions = project_points(np.maximum(points, (-np.inf, -np.inf, NEAR), dtype=np.float32))
    first = np.where(is_cut[:, None], -np.inf, np.minimum.reduceat(positions, starts) - _MARGIN)
    last = np.where(is_cut[:, None], np.inf, np.maximum.reduceat(positions, starts) + _MARGIN)
    rows, columns = np.divmod(pixels, IMAGE_SIZE)
    inside = (columns >= first[:, :1]) & (columns <= last[:, :1]) & (rows >= first[:, 1:]) & (rows <= last[:, 1:])
    return [pixels[is_inside] for is_inside in inside]


def _clip_at_near_plane(corners: Array, behind: Flags) -> tuple[Array, Flags]:
    """Clip triangles (k, 3, 3) at the near plane.

    Returns:
        Six candidate corners (k, 6, 3) of each polygon, and whether each candidate is one (k, 6).
    """
    following, follows = np.roll(corners, -1, axis=1), np.roll(behind, -1, axis=1)
    crossing = behind != follows
    rise = np.where(crossing, following[..., 2] - corners[..., 2], np.float32(1.0))
    share = (np.float32(NEAR) - corners[..., 2]) / rise
    between = corners + share[..., None] * (following - corners)
    return np.concatenate([corners, between], axis=1), np.concatenate([~behind, crossing], axis=1)


def _bound_front_faces(positions: Array, faces: npt.NDArray[np.int32]) -> Boxes:
    """Return pixel boxes (4, k) of triangles: first columns, first rows, last columns, last rows.

    Back faces, triangles between pixels and triangles outside of the image are left out.

    Args:
        positions: (v, 2) columns and rows of the vertices.
        faces: (f, 3) vertex numbers.
    """
    # Contiguous columns: three times as fast as short rows.
    one, two, three = (np.ascontiguousarray(corner) for corner in faces.T)
    edges, lowest, highest = [], [], []
    for position in (np.ascontiguousarray(axis) for axis in positions.T):
        a, b, c = position[one], position[two], position[three]
        edges.append((b - a, c - a))
        lowest.append(np.minimum(np.minimum(a, b), c))
        highest.append(np.maximum(np.maximum(a, b), c))
    (first_x, second_x), (first_y, second_y) = edges
    # Rows count downwards, so counterclockwise is negative; edge-on triangles may round to either sign.
    is_front = first_x * second_y - first_y * second_x <= 1e-6
    return _round_boxes(lowest, highest, is_front)


def _bound_polygons(corners: Array, counts: Flags) -> Boxes:
    """Return pixel boxes (4, k) of polygons from candidate corners (k, m, 3).

    Only the corners with a true flag (k, m) count.
    """
    positions = project_points(np.where(counts[..., None], corners, np.float32(1.0)))
    lowest = np.where(counts[..., None], positions, np.float32(np.inf)).min(axis=1)
    highest = np.where(counts[..., None], positions, np.float32(-np.inf)).max(axis=1)
    return _round_boxes(list(lowest.T), list(highest.T), np.ones(len(corners), dtype=bool))


def _round_boxes(lowest: list[Array], highest: list[Array], selected: Flags) -> Boxes:
    first = [np.ceil(np.maximum(low - _MARGIN, np.float32(0.0))) for low in lowest]
    last = [np.floor(np.minimum(high + _MARGIN, np.float32(IMAGE_SIZE - 1))) for high in highest]
    chosen = np.flatnonzero(selected & (first[0] <= last[0]) & (first[1] <= last[1]))
    return np.stack([end[chosen] for end in (*first, *last)]).astype(np.int64)


def _find_covered_pixels(boxes: Boxes) -> Pixels:
    """Return the pixels in at least one pixel box, ascending."""
    if not boxes.shape[1]:
        return np.zeros(0, dtype=np.int64)
    left, top, right, bottom = boxes
    first_column, first_row = int(left.min()), int(top.min())
    width, height = int(right.max()) - first_column + 2, int(bottom.max()) - first_row + 2
    # Two-dimensional prefix sums: each box adds one at its first corner and subtracts it behind its sides.
    above, below = (top - first_row) * width - first_column, (bottom - first_row + 1) * width - first_column
    change = np.bincount(np.concatenate([above + left, below + right + 1]), minlength=height * width)
    change -= np.bincount(np.concatenate([above + right + 1, below + left]), minlength=height * width)
    counts = change.reshape(height, width).cumsum(axis=0).cumsum(axis=1)
    rows, columns = np.divmod(np.flatnonzero(counts), width)
    pixels: Pixels = (rows + first_row) * IMAGE_SIZE + columns + first_column
    return pixels
