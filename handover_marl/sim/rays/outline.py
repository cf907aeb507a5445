"""Telling, before any ray is cast, which pixels can show some triangles."""

import numpy as np
import numpy.typing as npt

from handover_marl.sim.camera.optics import CENTER, NEAR, SAMPLED_AT, SIDE

Array = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Boxes = npt.NDArray[np.int64]
#: Numbers of pixels, row by row.
Pixels = npt.NDArray[np.int64]

# Pixels on which the edge of a triangle may fall count too, however the projection rounds.
_MARGIN = np.float32(0.01)
# Where the axis meets the picture, counted in sampled places.
_OFFSET = np.array([CENTER - SAMPLED_AT[0], CENTER - SAMPLED_AT[1]], dtype=np.float32)


def outlined_pixels(points: Array, faces: npt.NDArray[np.int32]) -> Pixels:
    """The pixels in boxes around triangles that turn their front to the camera, ascending.

    Args:
        points: (v, 3) float32 in the camera's frame: x right, y down, z ahead (m).
        faces: (f, 3) their corners, counterclockwise seen from outside.
    """
    nearer = points[:, 2] < NEAR
    if not nearer.any():
        return _covered(_boxes_in_front(projected(points), faces))
    behind = nearer[faces]
    some = behind.any(axis=1)
    cut = some & ~behind.all(axis=1)
    # Points behind are projected to nonsense, of which none is used.
    places = projected(np.where(nearer[:, None], np.float32(1.0), points))
    boxes = [_boxes_in_front(places, faces[~some])]
    if cut.any():
        boxes.append(_boxes(*_clipped(points[faces[cut]], behind[cut])))
    return _covered(np.concatenate(boxes, axis=1))


def projected(points: Array) -> Array:
    """(..., 2) column and row, with fractions, of points (..., 3) in front of the camera."""
    places: Array = _OFFSET + np.float32(CENTER) * points[..., :2] / points[..., 2:]
    return places


def pixels_within(pixels: Pixels, parts: list[Array]) -> list[Pixels]:
    """Those of some pixels that are in a box around each part of a body; all, for parts that reach the near plane.

    Args:
        pixels: The pixels.
        parts: (v, 3) points of each part in the camera's frame.
    """
    points = np.concatenate(parts)
    starts = np.cumsum([0, *map(len, parts[:-1])])
    cut = np.minimum.reduceat(points[:, 2], starts) < NEAR
    places = projected(np.maximum(points, (-np.inf, -np.inf, NEAR), dtype=np.float32))
    first = np.where(cut[:, None], -np.inf, np.minimum.reduceat(places, starts) - _MARGIN)
    last = np.where(cut[:, None], np.inf, np.maximum.reduceat(places, starts) + _MARGIN)
    rows, columns = np.divmod(pixels, SIDE)
    inside = (columns >= first[:, :1]) & (columns <= last[:, :1]) & (rows >= first[:, 1:]) & (rows <= last[:, 1:])
    return [pixels[share] for share in inside]


def _clipped(corners: Array, behind: Flags) -> tuple[Array, Flags]:
    """Corners (k, 6, 3) of triangles cut at the near plane, and which of them count: its own and those on the plane."""
    following, follows = np.roll(corners, -1, axis=1), np.roll(behind, -1, axis=1)
    crossing = behind != follows
    rise = np.where(crossing, following[..., 2] - corners[..., 2], np.float32(1.0))
    share = (np.float32(NEAR) - corners[..., 2]) / rise
    between = corners + share[..., None] * (following - corners)
    return np.concatenate([corners, between], axis=1), np.concatenate([~behind, crossing], axis=1)


def _boxes_in_front(places: Array, faces: npt.NDArray[np.int32]) -> Boxes:
    """(4, k) first columns, first rows, and last ones, of triangles' pixels.

    Left out are triangles without a pixel, outside of the picture, and such as turn their back.

    Args:
        places: (v, 2) column and row of points.
        faces: (f, 3) which of them are the corners.
    """
    # Whole columns at a time, which is a third of the work of small rows.
    one, two, three = (np.ascontiguousarray(corner) for corner in faces.T)
    across, down = (np.ascontiguousarray(place) for place in places.T)
    ends, corners = [], []
    for place in (across, down):
        a, b, c = place[one], place[two], place[three]
        corners.append((b - a, c - a))
        ends.append((np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)))
    (aside, along), (below, beneath) = corners
    # Rows count downwards, so that counterclockwise is negative; what is seen edgewise may round to either side.
    front = aside * beneath - below * along <= 1e-6
    lowest, highest = zip(*ends, strict=True)
    return _inside(lowest, highest, front)


def _boxes(corners: Array, counts: Flags) -> Boxes:
    """As `_boxes_in_front`, for corners (k, m, 3) of which only some count (k, m), whichever side they show."""
    places = projected(np.where(counts[..., None], corners, np.float32(1.0)))
    lowest = np.where(counts[..., None], places, np.float32(np.inf)).min(axis=1)
    highest = np.where(counts[..., None], places, np.float32(-np.inf)).max(axis=1)
    return _inside(tuple(lowest.T), tuple(highest.T), np.ones(len(corners), dtype=bool))


def _inside(lowest: tuple[Array, ...], highest: tuple[Array, ...], wanted: Flags) -> Boxes:
    first = [np.ceil(np.maximum(low - _MARGIN, np.float32(0.0))) for low in lowest]
    last = [np.floor(np.minimum(high + _MARGIN, np.float32(SIDE - 1))) for high in highest]
    there = np.flatnonzero(wanted & (first[0] <= last[0]) & (first[1] <= last[1]))
    return np.stack([end[there] for end in (*first, *last)]).astype(np.int64)


def _covered(boxes: Boxes) -> Pixels:
    """Numbers of the pixels that at least one box covers, ascending."""
    if not boxes.shape[1]:
        return np.zeros(0, dtype=np.int64)
    left, top, right, bottom = boxes
    start, begin = int(left.min()), int(top.min())
    wide, high = int(right.max()) - start + 2, int(bottom.max()) - begin + 2
    # A box adds one from its first corner on and takes it away behind its sides.
    above, below = (top - begin) * wide - start, (bottom - begin + 1) * wide - start
    change = np.bincount(np.concatenate([above + left, below + right + 1]), minlength=high * wide)
    change -= np.bincount(np.concatenate([above + right + 1, below + left]), minlength=high * wide)
    counts = change.reshape(high, wide).cumsum(axis=0).cumsum(axis=1)
    rows, columns = np.divmod(np.flatnonzero(counts), wide)
    numbers: Pixels = (rows + begin) * SIDE + columns + start
    return numbers
