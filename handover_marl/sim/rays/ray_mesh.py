"""Casting rays at one rigid mesh, and telling beforehand which pixels can show it. Needs the extra `vision`."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from handover_marl.sim.camera.optics import CENTER, FAR, NEAR, SAMPLED_AT, SIDE

Array = npt.NDArray[np.float32]
#: Numbers of pixels, row by row.
Pixels = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# How far behind a face that is seen from its back a ray goes on (m).
_BEHIND = np.float32(1e-5)
# A ray that meets more back faces than this is lost in a mesh that is all inside out.
_DEEPEST = 32
# Pixels on which the edge of a triangle may fall are cast too, however the projection rounds.
_MARGIN = np.float32(0.01)
# Where the axis meets the picture, counted in sampled places.
_OFFSET = np.array([CENTER - SAMPLED_AT[0], CENTER - SAMPLED_AT[1]], dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met first: `depth` (n,) along the viewing axis (m), inf where nothing, and `face` (n,), -1 there."""

    depth: Array
    face: npt.NDArray[np.int32]


class RayMesh:
    """A rigid mesh, seen from outside only.

    Args:
        vertices: (v, 3) float32 (m).
        faces: (f, 3) int32, counterclockwise seen from outside.
    """

    def __init__(self, vertices: Array, faces: npt.NDArray[np.int32]) -> None:
        self.vertices, self.faces = vertices, faces
        corners = vertices[faces]
        #: (f, 3) outward normals, as long as twice the triangle's area.
        self.normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        #: A ball around it: center (3,) and radius (m).
        self.center, self.radius = middle, float(np.linalg.norm(vertices - middle, axis=1).max())
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)

    def may_show(self, turn: Array, shift: Array) -> bool:
        """Whether it can be in the picture.

        Args:
            turn: (3, 3) its axes in the camera's frame: x right, y down, z ahead.
            shift: (3,) its origin in that frame (m).
        """
        x, y, z = turn @ self.center + shift
        far_out = np.sqrt(2.0) * self.radius
        return bool(z + self.radius > NEAR and z - self.radius < FAR and max(abs(x), abs(y)) - far_out < z)

    def pixels(self, turn: Array, shift: Array) -> Pixels:
        """The pixels outside of which it cannot be seen: those in a box around one of its front faces.

        Args:
            turn: As in `may_show`, and so is
            shift: its origin.
        """
        points = self.vertices @ turn.T + shift
        seen_from = -(shift @ turn)
        front = np.einsum("ij,ij->i", self.normals, seen_from - self.vertices[self.faces[:, 0]]) > 0.0
        faces = self.faces[front]
        nearer = points[:, 2] < NEAR
        if not nearer.any():
            return _covered(_boxes_in_front(_projected(points)[faces]))
        behind = nearer[faces]
        whole, cut = ~behind.any(axis=1), behind.any(axis=1) & ~behind.all(axis=1)
        # Points behind are projected to nonsense, of which none is used.
        points_ahead = np.where(nearer[:, None], np.float32(1.0), points)
        boxes = [_boxes_in_front(_projected(points_ahead)[faces[whole]])]
        if cut.any():
            boxes.append(_boxes(*_clipped(points[faces[cut]], behind[cut])))
        return _covered(np.concatenate(boxes))

    def cast(self, turn: Array, shift: Array, ways: Array, ends: Array) -> Hits:
        """What rays from the pinhole meet first beyond the near plane, back faces passed through.

        Args:
            turn: As in `may_show`, and so is
            shift: its origin.
            ways: (n, 3) float32 directions with z = 1, so that lengths are depths.
            ends: (n,) float32 depths that are of no interest any more (m).
        """
        own_ways = ways @ turn
        start = -(shift @ turn)
        count = len(ways)
        depth, face = np.full(count, np.inf, dtype=np.float32), np.full(count, -1, dtype=np.int32)
        begun, left = np.full(count, NEAR, dtype=np.float32), np.arange(count)
        for _ in range(_DEEPEST):
            if not len(left):
                break
            way, begin = own_ways[left], begun[left]
            found = self._scene.run(start + begin[:, None] * way, way, dists=ends[left] - begin, output=1)
            number, reached = found["primID"], begin + found["tfar"]
            met = number >= 0
            outside = met & (np.einsum("ij,ij->i", self.normals[number], way) < 0.0)
            depth[left[outside]], face[left[outside]] = reached[outside], number[outside]
            inside = met & ~outside
            begun[left[inside]] = reached[inside] + _BEHIND
            left = left[inside]
        return Hits(depth, face)


def _clipped(corners: Array, behind: Flags) -> tuple[Array, Flags]:
    """Corners (k, 6, 3) of triangles cut at the near plane, and which of them count: its own and those on the plane."""
    following, follows = np.roll(corners, -1, axis=1), np.roll(behind, -1, axis=1)
    crossing = behind != follows
    rise = np.where(crossing, following[..., 2] - corners[..., 2], np.float32(1.0))
    share = (np.float32(NEAR) - corners[..., 2]) / rise
    between = corners + share[..., None] * (following - corners)
    return np.concatenate([corners, between], axis=1), np.concatenate([~behind, crossing], axis=1)


def _projected(points: Array) -> Array:
    """(..., 2) column and row, with fractions, of points (..., 3) in front of the camera."""
    places: Array = _OFFSET + np.float32(CENTER) * points[..., :2] / points[..., 2:]
    return places


def _boxes_in_front(places: Array) -> npt.NDArray[np.int64]:
    """(k, 4) first column, first row, and last ones, of triangles' pixels; empty ones and those outside left out.

    Args:
        places: (n, 3, 2) column and row of their corners.
    """
    one, two, three = places[:, 0], places[:, 1], places[:, 2]
    lowest = np.minimum(np.minimum(one, two), three)
    highest = np.maximum(np.maximum(one, two), three)
    return _inside(lowest, highest)


def _boxes(corners: Array, counts: Flags) -> npt.NDArray[np.int64]:
    """As `_boxes_in_front`, for corners (k, m, 3) of which only some count (k, m)."""
    places = _projected(np.where(counts[..., None], corners, np.float32(1.0)))
    lowest = np.where(counts[..., None], places, np.inf).min(axis=1)
    highest = np.where(counts[..., None], places, -np.inf).max(axis=1)
    return _inside(lowest, highest)


def _inside(lowest: Array, highest: Array) -> npt.NDArray[np.int64]:
    first = np.ceil(np.clip(lowest - _MARGIN, 0, SIDE)).astype(np.int64)
    last = np.floor(np.clip(highest + _MARGIN, -1, SIDE - 1)).astype(np.int64)
    there = (first <= last).all(axis=1)
    return np.concatenate([first[there], last[there]], axis=1)


def _covered(boxes: npt.NDArray[np.int64]) -> Pixels:
    """Numbers of the pixels that at least one box covers, ascending."""
    if not len(boxes):
        return np.zeros(0, dtype=np.int64)
    (left, top), (right, bottom) = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    wide, high = right - left + 2, bottom - top + 2
    first, last = boxes[:, :2] - (left, top), boxes[:, 2:] - (left - 1, top - 1)
    # A box adds one from its first corner on and takes it away behind its sides.
    change = np.bincount(np.concatenate([first[:, 1] * wide + first[:, 0], last[:, 1] * wide + last[:, 0]]))
    change = np.pad(change, (0, high * wide - len(change)))
    less = np.bincount(np.concatenate([first[:, 1] * wide + last[:, 0], last[:, 1] * wide + first[:, 0]]))
    change[: len(less)] -= less
    counts = change.reshape(high, wide).cumsum(axis=0).cumsum(axis=1)
    rows, columns = np.nonzero(counts)
    numbers: Pixels = (rows + top) * SIDE + columns + left
    return numbers
