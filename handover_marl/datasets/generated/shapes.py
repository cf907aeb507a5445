"""Convex parts of procedural objects, with analytic distances and surfaces.

Lengths are in metres. A surface is a stack of rings: convex outlines with parallel edges, so that the
quadrilaterals between two rings are planar and the part is their convex hull.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final, Literal, Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.synthetic.random_stream import RandomStream
from handover_marl.geometry.poses import compute_cross_products

Array = npt.NDArray[np.float64]
Columns = tuple[Array, Array, Array]
Faces = npt.NDArray[np.int64]
PartKind = Literal["box", "cone", "superellipsoid"]

_N_CORNER, _N_CIRCLE, _N_ELLIPSE, _N_LATITUDES = 3, 24, 20, 9
_SMALL = 1e-9
# Numbers of rays and points that are computed together. Arrays of less than 128 KiB reuse memory; the C library
# returns larger ones to the system, which takes longer than to compute with them.
_N_RAYS, _N_POINTS = 64, 8192
#: Distance (m) of the points between which normals are computed.
_NORMAL_STEP: Final = 1e-4


@dataclass(frozen=True)
class Part:
    """Convex part of an object.

    Attributes:
        kind: "box"; "cone", a truncated cone about z; or "superellipsoid".
        size: Half lengths along x, y and z (m); of a cone the radii at the lower and the upper end and half its length.
        color: Name of a color in the palette of the object models.
        rounding: Radius (m) of the edges of a box or cone.
        exponents: Exponents along z and in the xy plane of a superellipsoid: 1 is round, 0 angular.
        position: Position of the part's center in the object (m).
        axis: Axis of the object along which the part's z axis points: 0, 1 or 2.
    """

    kind: PartKind
    size: tuple[float, float, float]
    color: str
    rounding: float = 0.0
    exponents: tuple[float, float] = (1.0, 1.0)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: int = 2

    def move(self, offset: npt.ArrayLike) -> "Part":
        """Return the part moved by an offset (3,) (m)."""
        x, y, z = (np.asarray(self.position) + offset).tolist()
        return replace(self, position=(x, y, z))

    def compute_distances(self, points: Array) -> Array:
        """Return signed distances (...) of points (..., 3) in the object's frame, negative inside (m).

        Distances to a superellipsoid are approximate: exact to first order near the surface, and too
        small farther outside. Deep inside only their sign is right.
        """
        return self.compute_column_distances((points[..., 0], points[..., 1], points[..., 2]))

    def compute_column_distances(self, columns: Columns) -> Array:
        """Return signed distances (...) of points with coordinates x, y and z (...), as `compute_distances` (m).

        Arrays of one coordinate are several times as fast as one array of points, whose last dimension is short.
        """
        order = ((self.axis + 1) % 3, (self.axis + 2) % 3, self.axis)
        x, y, z = (columns[axis] - self.position[axis] for axis in order)
        if self.kind == "box":
            return _box_distances(x, y, z, self.size, self.rounding)
        if self.kind == "cone":
            return _cone_distances(np.hypot(x, y), z, self.size, self.rounding)
        return _superellipsoid_distances(x, y, z, self.size, self.exponents)

    def make_rings(self) -> Array:
        """Return the rings (m, n, 3) of the surface in the object's frame, from the lower to the upper end."""
        if self.kind == "box":
            rings = _box_rings(self.size, self.rounding)
        elif self.kind == "cone":
            rings = _cone_rings(self.size, self.rounding)
        else:
            rings = _superellipsoid_rings(self.size, self.exponents)
        # The rings are about z; z becomes `axis`.
        order = ((2 - self.axis) % 3, (3 - self.axis) % 3, (4 - self.axis) % 3)
        return np.asarray(np.take(rings, order, axis=-1) + np.array(self.position))

    def compute_vertices(self) -> Array:
        """Return the vertices (v, 3) of the surface in the object's frame (m): those of the rings, and both ends."""
        rings = self.make_rings()
        return np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])


@dataclass(frozen=True, eq=False)
class ConvexSurface:
    """Surface of a convex part as polygon mesh.

    Attributes:
        vertices: (v, 3) vertices (m).
        faces: (f, 3) vertex numbers of triangles, counterclockwise seen from outside.
        normals: (p, 3) outward unit normals of the planes that bound the part.
        offsets: (p,) distances of these planes from the origin along their normals (m).
    """

    vertices: Array
    faces: Faces
    normals: Array
    offsets: Array

    def find_exits(self, points: Array, directions: Array) -> tuple[Array, Array]:
        """Return lengths (k,) in m and normals (k, 3) where rays from points (k, 3) in the part leave it."""
        lengths, planes = np.empty(len(points)), np.empty(len(points), dtype=np.int64)
        for start in range(0, len(points), _N_RAYS):
            rows = slice(start, start + _N_RAYS)
            slopes = directions[rows] @ self.normals.T
            gaps = self.offsets - points[rows] @ self.normals.T
            exits = np.where(slopes > _SMALL, gaps / np.maximum(slopes, _SMALL), np.inf)
            planes[rows] = exits.argmin(axis=1)
            lengths[rows] = exits[np.arange(len(exits)), planes[rows]]
        return lengths, self.normals[planes]


def make_surface(part: Part) -> ConvexSurface:
    """Return the surface of a part in the object's frame."""
    rings = part.make_rings()
    ends = rings[[0, -1]].mean(axis=1)
    vertices = np.concatenate([rings.reshape(-1, 3), ends])
    quads, bottom, top = _make_polygons(*rings.shape[:2])
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]], bottom, top])
    corners = vertices[quads]
    # Diagonals and whole rings: stable where edges are short or have no length.
    across = compute_cross_products(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    around_ends = [vertices[cap[:, 1:]] - vertices[cap[:, :1]] for cap in (bottom, top)]
    caps = [compute_cross_products(edges[:, 0], edges[:, 1]).sum(axis=0) for edges in around_ends]
    normals, points = np.concatenate([across, caps]), np.concatenate([corners.mean(axis=1), ends])
    lengths = np.linalg.norm(normals, axis=1)
    wide = lengths > 1e-12
    normals = normals[wide] / lengths[wide, None]
    return ConvexSurface(vertices, faces, normals, np.einsum("pi,pi->p", normals, points[wide]))


@cache
def _make_polygons(m: int, n: int) -> tuple[Faces, Faces, Faces]:
    """Return the vertex numbers of the polygons of m rings of n vertices: sides (k, 4), lower and upper end (n, 3)."""
    around = np.arange(n)
    ahead = np.roll(around, -1)
    low = n * np.arange(m - 1)[:, None]
    quads = np.stack([low + around, low + ahead, low + n + ahead, low + n + around], axis=-1).reshape(-1, 4)
    bottom = np.stack([np.full(n, m * n), ahead, around], axis=-1)
    top = np.stack([np.full(n, m * n + 1), (m - 1) * n + around, (m - 1) * n + ahead], axis=-1)
    return quads, bottom, top


@dataclass(frozen=True, eq=False)
class _Triangles:
    """Triangles of all parts of a solid.

    Attributes:
        corners: (k, 3, 3) corners (m).
        normals: (k, 3) outward normals of length `areas`.
        areas: (k,) areas times 2 (m^2).
        owner: (k,) indices of their parts.
    """

    corners: Array
    normals: Array
    areas: Array
    owner: Faces


class GraspableSolid(Protocol):
    """Solid for which grasps are drawn; see `Solid`."""

    @property
    def corners(self) -> Array:
        """Vertices (n, 3) of the surface (m)."""

    def compute_distances(self, points: Array) -> Array:
        """Return signed distances (...) of points (..., 3), negative inside (m)."""

    def compute_normals(self, points: Array) -> Array:
        """Return outward unit normals (..., 3) at points (..., 3) near the surface."""

    def mirror(self) -> "GraspableSolid":
        """Return the solid mirrored in x."""

    def sample_opposite_points(
        self, random: RandomStream, count: int, max_width: float, tilt: float
    ) -> tuple[Array, Array, Array]:
        """Sample pairs of opposite surface points."""


class Solid:
    """Union of convex parts.

    Args:
        parts: Parts in the object's frame.

    Attributes:
        parts: Parts, not mirrored.
    """

    def __init__(self, parts: tuple[Part, ...]) -> None:
        self.parts = parts
        self._flip = np.ones(3)

    def mirror(self) -> "Solid":
        """Return the solid mirrored in x, as it is for the grasps of left hands."""
        mirrored = Solid(self.parts)
        # The surfaces do not depend on the side.
        vars(mirrored).update(surfaces=self.surfaces, _triangles=self._triangles)
        mirrored._flip = self._flip * [-1.0, 1.0, 1.0]
        return mirrored

    @cached_property
    def surfaces(self) -> tuple[ConvexSurface, ...]:
        """Surfaces of the parts, not mirrored."""
        return tuple(make_surface(part) for part in self.parts)

    @cached_property
    def _triangles(self) -> _Triangles:
        corners = [surface.vertices[surface.faces] for surface in self.surfaces]
        owner = np.repeat(np.arange(len(corners)), [len(part) for part in corners])
        joined = np.concatenate(corners)
        normals = compute_cross_products(joined[:, 1] - joined[:, 0], joined[:, 2] - joined[:, 0])
        return _Triangles(joined, normals, np.linalg.norm(normals, axis=1), owner)

    @property
    def corners(self) -> Array:
        """Vertices (n, 3) of all parts (m)."""
        return np.concatenate([part.compute_vertices() for part in self.parts]) * self._flip

    def compute_distances(self, points: Array) -> Array:
        """Return signed distances (...) of points (..., 3), negative inside (m)."""
        flat = points.reshape(-1, 3)
        distances = np.empty(len(flat))
        for start in range(0, len(flat), _N_POINTS):
            rows = slice(start, start + _N_POINTS)
            x, y, z = self._flip[0] * flat[rows, 0], flat[rows, 1].copy(), flat[rows, 2].copy()
            found = self.parts[0].compute_column_distances((x, y, z))
            for part in self.parts[1:]:
                found = np.minimum(found, part.compute_column_distances((x, y, z)))
            distances[rows] = found
        return distances.reshape(points.shape[:-1])

    def compute_normals(self, points: Array) -> Array:
        """Return outward unit normals (..., 3) at points (..., 3) near the surface."""
        steps = _NORMAL_STEP * np.concatenate([np.eye(3), -np.eye(3)])
        around = self.compute_distances(points[..., None, :] + steps)
        slopes = around[..., :3] - around[..., 3:]
        return np.asarray(slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), _SMALL))

    def sample_opposite_points(
        self, random: RandomStream, count: int, max_width: float, tilt: float
    ) -> tuple[Array, Array, Array]:
        """Sample pairs of opposite points on the outer surface, both on one part, from `count` surface points.

        Pairs are at most `max_width` apart (m); `tilt` is the standard deviation of the components (rad) by
        which rays deviate from the normal. Returns points (k, 3), opposite points (k, 3) in m, and cosines (k,)
        of the angles between the rays and the normals at the opposite points.
        """
        draws, noise = random.uniforms(count, 3), random.normals(count, 3)
        areas = self._triangles.areas
        chosen = np.searchsorted(np.cumsum(areas), draws[:, 0] * areas.sum()).clip(max=len(areas) - 1)
        corners, owner = self._triangles.corners[chosen], self._triangles.owner[chosen]
        outward = self._triangles.normals[chosen] / areas[chosen, None]
        root = np.sqrt(draws[:, 1:2])
        weights = np.concatenate([1.0 - root, root * (1.0 - draws[:, 2:]), root * draws[:, 2:]], axis=1)
        points = np.einsum("nk,nkc->nc", weights, corners)
        directions = tilt * noise - outward
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths, cosines = np.empty(count), np.empty(count)
        for number, surface in enumerate(self.surfaces):
            rows = np.flatnonzero(owner == number)
            lengths[rows], exit_normals = surface.find_exits(points[rows], directions[rows])
            cosines[rows] = np.einsum("ni,ni->n", exit_normals, directions[rows])
        opposite = points + lengths[:, None] * directions
        good = (lengths < max_width) & (lengths > 0.002)
        for number, part in enumerate(self.parts if len(self.parts) > 1 else ()):
            others = np.flatnonzero(good & (owner != number))
            ends = np.stack([points[others], opposite[others]])
            good[others] = (part.compute_distances(ends) >= 0.0).all(axis=0)
        return points[good] * self._flip, opposite[good] * self._flip, cosines[good]


def _box_distances(x: Array, y: Array, z: Array, size: tuple[float, float, float], rounding: float) -> Array:
    x, y, z = (np.abs(column) - (half - rounding) for column, half in zip((x, y, z), size, strict=True))
    inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
    x, y, z = (np.maximum(column, 0.0) for column in (x, y, z))
    return np.asarray(np.sqrt(x * x + y * y + z * z) + inside - rounding)


def _cone_distances(radius: Array, z: Array, size: tuple[float, float, float], rounding: float) -> Array:
    """Return distances to a truncated cone (after Quilez, "Distance functions": capped cone)."""
    low, high, half = (value - rounding for value in size)
    cap_r, cap_z = np.maximum(radius - np.where(z < 0.0, low, high), 0.0), np.abs(z) - half
    side = np.array([high - low, 2.0 * half])
    share = np.maximum(((high - radius) * side[0] + (half - z) * side[1]) / (side @ side), 0.0)
    share = np.minimum(share, 1.0)
    side_r, side_z = radius - high + side[0] * share, z - half + side[1] * share
    is_inside = (side_r < 0.0) & (cap_z < 0.0)
    distances = np.sqrt(np.minimum(cap_r * cap_r + cap_z * cap_z, side_r * side_r + side_z * side_z))
    return np.asarray(np.where(is_inside, -distances, distances) - rounding)


def _superellipsoid_distances(
    x: Array, y: Array, z: Array, size: tuple[float, float, float], exponents: tuple[float, float]
) -> Array:
    """Return (gauge - 1) / |gradient of the gauge|, a lower bound of the distance outside."""
    along, across = exponents
    x, y, z = (np.maximum(np.abs(column) / half, 1e-6) for column, half in zip((x, y, z), size, strict=True))
    power_x, power_y, upright = x ** (2.0 / across), y ** (2.0 / across), z ** (2.0 / along)
    flat = power_x + power_y
    inner = flat ** (across / along)
    total = inner + upright
    gauge = total ** (along / 2.0)
    # Derivatives of the gauge by the scaled coordinates; it is homogeneous of degree 1.
    ratio = gauge / total
    by_flat, by_z = ratio * inner / flat, ratio * upright / z / size[2]
    by_x, by_y = by_flat * power_x / x / size[0], by_flat * power_y / y / size[1]
    return np.asarray((gauge - 1.0) / np.sqrt(by_x * by_x + by_y * by_y + by_z * by_z))


def _box_rings(size: tuple[float, float, float], rounding: float) -> Array:
    x, y, z = size
    arc = np.linspace(0.0, np.pi / 2.0, _N_CORNER)
    angles = (np.arange(4)[:, None] * np.pi / 2.0 + arc).ravel()
    signs = np.repeat([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], _N_CORNER, axis=0)
    corners = signs * (np.array([x, y]) - rounding)
    rings = []
    # Levels of the rounded edge: the outline is smaller at the ends.
    for height, inset in _rounded_levels(z, rounding):
        outline = corners + (rounding - inset) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        rings.append(np.column_stack([outline, np.full(len(outline), height)]))
    return np.stack(rings)


def _cone_rings(size: tuple[float, float, float], rounding: float) -> Array:
    low, high, half = size
    angles = np.arange(_N_CIRCLE) * 2.0 * np.pi / _N_CIRCLE
    rings = []
    for height, inset in _rounded_levels(half, rounding):
        share = (height + half) / (2.0 * half)
        radius = low + share * (high - low) - inset
        rings.append(np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(_N_CIRCLE, height)], axis=1))
    return np.stack(rings)


def _rounded_levels(half: float, rounding: float) -> list[tuple[float, float]]:
    """Return heights and insets (m) of the rings of a solid with rounded ends."""
    if rounding == 0.0:
        return [(-half, 0.0), (half, 0.0)]
    inset = 0.7 * rounding
    return [(-half, inset), (-half + inset, 0.0), (half - inset, 0.0), (half, inset)]


def _superellipsoid_rings(size: tuple[float, float, float], exponents: tuple[float, float]) -> Array:
    along, across = exponents
    latitudes = np.linspace(-0.92, 0.92, _N_LATITUDES) * np.pi / 2.0
    turns = np.arange(_N_ELLIPSE) * 2.0 * np.pi / _N_ELLIPSE
    outline = np.stack([_signed_power(np.cos(turns), across), _signed_power(np.sin(turns), across)], axis=1)
    radii, heights = _signed_power(np.cos(latitudes), along), _signed_power(np.sin(latitudes), along)
    flat = radii[:, None, None] * outline
    upright = np.broadcast_to(heights[:, None, None], (_N_LATITUDES, _N_ELLIPSE, 1))
    return np.asarray(np.concatenate([flat, upright], axis=-1) * np.array(size))


def _signed_power(values: Array, exponent: float) -> Array:
    return np.asarray(np.sign(values) * np.maximum(np.abs(values), _SMALL) ** exponent)
