"""Procedural objects of random sizes, and objects as unions of convex polyhedra, also read from model files.

Lengths are in meters. The surface of each part of a procedural object is a stack of rings. Rings are convex outlines
with parallel edges: the quadrilaterals between two rings are planar, and a part is the convex hull of its rings. The
origin of a procedural object is the center of its bounding box. Every procedural object has a place that the Panda's
gripper, which opens to 80 mm, can span.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import COLLISION_NAME
from handover_marl.datasets.generated.config import OBJECT_KINDS
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.geometry.model_files.meshes import compute_convex_hull
from handover_marl.geometry.model_files.obj_files import read_obj
from handover_marl.geometry.vectors import compute_cross_products

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]
PartKind = Literal["box", "cone", "superellipsoid"]

_N_CORNER, _N_CIRCLE, _N_ELLIPSE, _N_LATITUDES = 3, 24, 20, 9
_SMALL = 1e-9
# Size of arrays that are computed at once. Arrays of less than 128 KiB reuse memory; the C library returns larger ones
# to the system, which takes longer than to compute with them.
_N_VALUES = 16_000
# Smallest length (m) of a ray in the solid, and distance that is beyond a surface and not on it.
_MIN_WIDTH, _STEP = 0.002, 1e-5
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
        """Return a copy of the part, moved by an offset (3,) in the object's frame (m)."""
        x, y, z = (np.asarray(self.position) + offset).tolist()
        return replace(self, position=(x, y, z))

    def make_rings(self) -> Array:
        """Return m rings of n points, (m, n, 3), of the surface in the object's frame (m), from lower to upper end."""
        if self.kind == "box":
            rings = _box_rings(self.size, self.rounding)
        elif self.kind == "cone":
            rings = _cone_rings(self.size, self.rounding)
        else:
            rings = _superellipsoid_rings(self.size, self.exponents)
        # The rings are about z; z becomes `axis`.
        order = ((2 - self.axis) % 3, (3 - self.axis) % 3, (4 - self.axis) % 3)
        return np.asarray(np.take(rings, order, axis=-1) + np.array(self.position))


@dataclass(frozen=True, eq=False)
class ConvexSurface:
    """Surface of a convex polyhedron.

    Attributes:
        vertices: (v, 3) vertices (m).
        faces: (f, 3) vertex numbers of triangles, counterclockwise seen from outside.
        normals: (p, 3) outward unit normals of the planes that bound the polyhedron.
        offsets: (p,) distances of these planes from the origin along their normals (m).
    """

    vertices: Array
    faces: Faces
    normals: Array
    offsets: Array


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


def read_solid(urdf: Path) -> "Solid":
    """Read the convex parts of an object from its collision mesh, the file `COLLISION_NAME` beside its URDF."""
    mesh = read_obj(urdf.with_name(COLLISION_NAME))
    return Solid(_make_hull(mesh.vertices[np.unique(faces)]) for faces in mesh.groups)


def _make_hull(points: Array) -> ConvexSurface:
    vertices, faces = compute_convex_hull(points)
    corners = vertices[faces]
    normals = normalize(compute_cross_products(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    planes = np.column_stack([normals, np.einsum("fi,fi->f", normals, corners[:, 0])])
    # Many triangles are in one plane.
    _, rows = np.unique(np.round(planes, 4), axis=0, return_index=True)
    return ConvexSurface(vertices, faces, planes[rows, :3], planes[rows, 3])


class Solid:
    """Union of convex polyhedra, on whose surface grasps are sampled.

    Args:
        parts: Surfaces of the polyhedra in the object's frame.

    Attributes:
        parts: Surfaces of the polyhedra, as passed.
        corners: (n, 3) vertices of all parts (m).
    """

    def __init__(self, parts: Iterable[ConvexSurface]) -> None:
        self.parts = tuple(parts)
        self.corners = np.concatenate([part.vertices for part in self.parts])
        self._normals = np.concatenate([part.normals for part in self.parts])
        self._offsets = np.concatenate([part.offsets for part in self.parts])[:, None]
        self._firsts = np.cumsum([0, *(len(part.offsets) for part in self.parts[:-1])])

    def mirror(self) -> "Solid":
        """Return a copy mirrored in x; a right hand grasps the copy as a left hand grasps this solid."""
        flip = np.array([-1.0, 1.0, 1.0])
        return Solid(
            ConvexSurface(part.vertices * flip, part.faces[:, ::-1], part.normals * flip, part.offsets)
            for part in self.parts
        )

    def compute_distances(self, points: Array) -> Array:
        """Return signed distances (...) in m of points (..., 3) from the surface, negative inside.

        Distances are to the bounding planes of the nearest part, so they are too small for points beyond an edge.
        """
        flat = points.reshape(-1, 3)
        distances = [self._measure_parts(rows.T).min(axis=0) for rows in self._split(flat)]
        return np.concatenate(distances).reshape(points.shape[:-1])

    def compute_normals(self, points: Array) -> Array:
        """Return outward unit normals (..., 3) at points (..., 3) near the surface."""
        steps = _NORMAL_STEP * np.concatenate([np.eye(3), -np.eye(3)])
        around = self.compute_distances(points[..., None, :] + steps)
        slopes = around[..., :3] - around[..., 3:]
        return np.asarray(slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), _SMALL))

    def sample_antipodal_points(
        self, random: RandomStream, count: int, max_width: float, direction_std: float
    ) -> tuple[Array, Array, Array]:
        """Sample antipodal points on the outer surface, by rays from `count` surface points through the solid.

        Pairs are at most `max_width` apart (m). Rays deviate from the normal by a random vector whose components have
        the standard deviation `direction_std` (rad). Returns k <= `count` points (k, 3) and opposite points (k, 3) in
        m, and the cosines (k,) between the rays and the outward normals at the opposite points.
        """
        draws, noise, choices = random.uniforms(count, 3), random.normals(count, 3), random.uniforms(count)
        corners = np.concatenate([part.vertices[part.faces] for part in self.parts])
        normals = compute_cross_products(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
        chosen = np.searchsorted(np.cumsum(areas), draws[:, 0] * areas.sum()).clip(max=len(areas) - 1)
        root = np.sqrt(draws[:, 1:2])
        weights = np.concatenate([1.0 - root, root * (1.0 - draws[:, 2:]), root * draws[:, 2:]], axis=1)
        points = np.einsum("nk,nkc->nc", weights, corners[chosen])
        directions = direction_std * noise - normals[chosen] / areas[chosen, None]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        rays = zip(self._split(points), self._split(directions), self._split(choices), strict=True)
        found = [self._find_exits(starts, ways, shares, max_width) for starts, ways, shares in rays]
        lengths, cosines = (np.concatenate(column) for column in zip(*found, strict=True))
        outside = points + _STEP * normals[chosen] / areas[chosen, None]
        good = np.flatnonzero((lengths < np.inf) & (self.compute_distances(outside) > 0.0))
        return points[good], points[good] + lengths[good, None] * directions[good], cosines[good]

    def _find_exits(self, points: Array, directions: Array, choices: Array, max_width: float) -> tuple[Array, Array]:
        """Return lengths (k,) in m at which k rays leave the solid, and cosines (k,) between ray and normal there.

        The rays have starts and unit directions (k, 3). A ray through a cup leaves it twice, at its wall and at its far
        side; numbers (k,) from 0 to 1 choose one of these. A length is infinite if no place is within `max_width`.
        """
        slopes, row = self._normals @ directions.T, np.arange(len(points))
        with np.errstate(divide="ignore", invalid="ignore"):
            steps = (self._offsets - self._normals @ points.T) / slopes
        starts = np.maximum.reduceat(np.where(slopes < 0.0, steps, -np.inf), self._firsts, axis=0)
        ends = np.minimum.reduceat(np.where(slopes > 0.0, steps, np.inf), self._firsts, axis=0)
        is_exit = (starts < ends) & (ends > _MIN_WIDTH) & (ends < max_width)
        if len(starts) > 1:
            is_exit &= ~((starts[:, None] < ends + _STEP) & (ends[:, None] > ends + _STEP)).any(axis=0)
        rank = np.floor(choices * is_exit.sum(axis=0)) + 1.0
        lengths = ends[(np.cumsum(is_exit, axis=0) == rank).argmax(axis=0), row]
        plane = ((steps == lengths) & (slopes > 0.0)).argmax(axis=0)
        return np.where(is_exit.any(axis=0), lengths, np.inf), slopes[plane, row]

    def _split(self, rows: Array) -> list[Array]:
        """Split an array (n, ...), one row per point or ray, into chunks of about `_N_VALUES` distances from planes."""
        step = max(_N_VALUES // len(self._offsets), 1)
        return [rows[start : start + step] for start in range(0, max(len(rows), 1), step)]

    def _measure_parts(self, points: Array) -> Array:
        """Return signed distances (k, n) in m of n points (3, n) from each of k parts, negative inside."""
        return np.maximum.reduceat(self._normals @ points - self._offsets, self._firsts, axis=0)


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
    """Return (height, inset) in m of each ring of a box or cone with half length `half` and edge radius `rounding`."""
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


def normalize(vectors: Array) -> Array:
    """Return vectors (..., 3) scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


_COLORS = ("black", "blue", "brown", "cream", "navy", "olive", "orange", "red", "steel", "white", "wood", "yellow")
_WALL = ("blue", "cream", "navy", "orange", "red", "white", "yellow")


@dataclass(frozen=True)
class ProceduralObject:
    """Procedural object, made of convex parts.

    Attributes:
        kind: One of `OBJECT_KINDS`.
        parts: Parts in the object's frame.
        up_axes: Weights by which the axis that points up on a table is drawn: +x, -x, +y, -y, +z, -z.
    """

    kind: str
    parts: tuple[Part, ...]
    up_axes: tuple[float, ...]


def draw_object(random: RandomStream, weights: tuple[float, ...]) -> ProceduralObject:
    """Draw a procedural object; `weights` are the relative probabilities of the kinds in `OBJECT_KINDS`."""
    kind = OBJECT_KINDS[random.weighted_index(weights)]
    parts, up_axes = _DRAWERS[kind](random)
    return ProceduralObject(kind, _center(parts), up_axes)


def _draw_box(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    # Thickness, width and height: a packet that stands, lies or leans on its side.
    size = (_length(random, 0.02, 0.07), _length(random, 0.035, 0.13), _length(random, 0.05, 0.21))
    x, y, z = (0.5 * length for length in size)
    box = Part("box", (x, y, z), _color(random, _WALL), rounding=_length(random, 0.001, 0.004))
    # Faces are weighted by their area.
    areas = (size[1] * size[2], size[0] * size[2], size[0] * size[1])
    return [box], tuple(float(np.round(area / max(areas), 3)) for area in np.repeat(areas, 2))


def _draw_cylinder(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    if random.uniform() < 0.2:
        radius, height = _length(random, 0.03, 0.048), _length(random, 0.02, 0.06)
    else:
        radius, height = _length(random, 0.010, 0.036), _length(random, 0.06, 0.22)
    taper = _length(random, 0.8, 1.0)
    size = (round(radius * taper, 4), radius, 0.5 * height)
    cylinder = Part("cone", size, _color(random, _COLORS), rounding=_length(random, 0.001, 0.003))
    stands = 1.0 if radius > 0.2 * height else 0.0
    lies = 0.1 if radius > 0.6 * height else 0.25
    return [cylinder], (lies, lies, lies, lies, stands, 0.3 * stands)


def _draw_bottle(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    radius, height = _length(random, 0.02, 0.036), _length(random, 0.07, 0.17)
    neck = _length(random, 0.008, min(0.016, 0.6 * radius))
    shoulder, cap = _length(random, 0.008, 0.03), _length(random, 0.015, 0.045)
    color, other = _color(random, _WALL), _color(random, _COLORS)
    if random.uniform() < 0.35:
        # Flat bottles, as of shampoo.
        wide = _length(random, radius, 0.05)
        body = Part("superellipsoid", (round(radius, 4), wide, 0.5 * height), color, exponents=(0.25, 0.7))
        shoulder_radius = radius
    else:
        body = Part("cone", (radius, radius, 0.5 * height), color, rounding=0.002)
        shoulder_radius = round(radius - 0.002, 4)
    cone = Part("cone", (shoulder_radius, neck, 0.5 * shoulder), color).move([0.0, 0.0, 0.5 * (height + shoulder)])
    top = Part("cone", (neck, neck, 0.5 * cap), other, rounding=0.001)
    parts = [body, cone, top.move([0.0, 0.0, 0.5 * height + shoulder + 0.5 * cap])]
    return parts, (0.4, 0.4, 0.2, 0.2, 1.0, 0.0)


def _draw_tool(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    length, thick = _length(random, 0.09, 0.17), _length(random, 0.009, 0.017)
    color, other = _color(random, _COLORS), _color(random, _COLORS)
    taper = round(thick * random.uniform(0.75, 1.0), 4)
    handle = Part("cone", (thick, taper, 0.5 * length), color, rounding=0.002, axis=0)
    form = random.integer(4)
    # Heads begin 5 mm inside of the handle's end.
    end = 0.5 * length - 0.005
    if form == 0:  # hammer
        half = (_length(random, 0.010, 0.016), _length(random, 0.03, 0.055), _length(random, 0.010, 0.016))
        head = Part("box", half, other, rounding=0.002).move([end + half[0], 0.0, 0.0])
    elif form == 1:  # screwdriver
        half = (_length(random, 0.003, 0.005), _length(random, 0.003, 0.005), 0.5 * _length(random, 0.06, 0.12))
        head = Part("cone", half, other, axis=0).move([end + half[2], 0.0, 0.0])
    elif form == 2:  # spatula
        half = (0.5 * _length(random, 0.06, 0.10), _length(random, 0.02, 0.038), _length(random, 0.0025, 0.004))
        head = Part("box", half, other, rounding=0.001).move([end + half[0], 0.0, 0.0])
    else:  # brush or club
        half = (_length(random, 0.018, 0.034), _length(random, 0.018, 0.034), 0.5 * _length(random, 0.05, 0.09))
        head = Part("superellipsoid", half, other, exponents=(0.6, 0.8), axis=0).move([end + half[2], 0.0, 0.0])
    return [handle, head], (0.0, 0.0, 0.2, 0.2, 1.0, 1.0)


def _draw_superquadric(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    half = (_length(random, 0.014, 0.034), _length(random, 0.02, 0.06), _length(random, 0.025, 0.095))
    exponents = (_length(random, 0.3, 1.0, 2), _length(random, 0.3, 1.0, 2))
    solid = Part("superellipsoid", half, _color(random, _COLORS), exponents=exponents)
    weights = tuple(float(np.round((min(half) / extent) ** 2, 3)) for extent in np.repeat(half, 2))
    return [solid], weights


_DRAWERS: Final = {
    "boxes": _draw_box,
    "cylinders": _draw_cylinder,
    "bottles": _draw_bottle,
    "tools": _draw_tool,
    "superquadrics": _draw_superquadric,
}


def _center(parts: list[Part]) -> tuple[Part, ...]:
    """Return the parts moved so that the bounding box is centered at the origin, to 0.1 mm."""
    corners = np.concatenate([make_surface(part).vertices for part in parts])
    middle: npt.NDArray[np.float64] = np.round(0.5 * (corners.min(axis=0) + corners.max(axis=0)), 4)
    return tuple(part.move(-middle) for part in parts)


def _length(random: RandomStream, low: float, high: float, digits: int = 4) -> float:
    """Draw a number from `low` to `high`, rounded to `digits` decimals: by default a length (m) to 0.1 mm."""
    return round(random.uniform(low, high), digits)


def _color(random: RandomStream, names: tuple[str, ...]) -> str:
    return names[random.integer(len(names))]
