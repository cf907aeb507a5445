"""Lofted surfaces with convex collision parts, the building blocks of the object models.

Lengths are in millimetres; `building.objects` converts them to metres. An outline is an array (n, 2), a
ring an outline in space (n, 3), a loft a surface through consecutive rings.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """Part of an object model: colored surfaces and convex collision bodies.

    Attributes:
        visual: Pairs of color name and surface.
        collision: Convex bodies that fill the piece; empty for a piece without collision.
    """

    visual: tuple[tuple[str, trimesh.Trimesh], ...]
    collision: tuple[trimesh.Trimesh, ...] = ()

    def transform(self, offset: Sequence[float] = (0, 0, 0), rotation_degrees: Sequence[float] = (0, 0, 0)) -> "Piece":
        """Return the piece rotated about the origin by a rotation vector (degrees) and then translated."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(rotation_degrees, degrees=True).as_matrix()
        matrix[:3, 3] = offset
        return Piece(
            tuple((color, mesh.copy().apply_transform(matrix)) for color, mesh in self.visual),
            tuple(mesh.copy().apply_transform(matrix) for mesh in self.collision),
        )


def make_ellipse(half_x: float, half_y: float | None = None, n: int = 32, exponent: float = 2.0) -> Array:
    """Return the outline (n, 2) of the curve |x/half_x|^exponent + |y/half_y|^exponent = 1.

    Exponents above 2 approach a rectangle with rounded corners.
    """
    angle = np.arange(n) * 2 * np.pi / n
    cosine, sine = np.cos(angle), np.sin(angle)
    radius = (np.abs(cosine) ** exponent + np.abs(sine) ** exponent) ** (-1 / exponent)
    return np.stack([half_x * radius * cosine, (half_x if half_y is None else half_y) * radius * sine], axis=1)


def make_rectangle(size_x: float, size_y: float, corner: float, n_corner: int = 4) -> Array:
    """Return the outline (n, 2) of a rectangle at the origin, whose rounded corners have `n_corner` points each."""
    arc = np.linspace(0, np.pi / 2, n_corner)
    rounded = []
    for quarter, (sign_x, sign_y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        center = np.array([sign_x * (size_x / 2 - corner), sign_y * (size_y / 2 - corner)])
        angle = arc + quarter * np.pi / 2
        rounded.append(center + corner * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(rounded)


def make_span(low: Sequence[float], high: Sequence[float], corner: float = 0.0, exponent: float = 0.0) -> Array:
    """Return the outline (n, 2) of a rectangle, or of a superellipse of an exponent, with a bounding box (x, y)."""
    lower, upper = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    x, y = (upper - lower).tolist()
    outline = make_ellipse(x / 2, y / 2, exponent=exponent) if exponent else make_rectangle(x, y, corner)
    return np.asarray(outline + (lower + upper) / 2)


def stack_outlines(outlines: Iterable[Array], heights: Iterable[float]) -> Array:
    """Return rings (m, n, 3): m outlines (n, 2), each at its height z."""
    return np.stack(
        [np.c_[outline, np.full(len(outline), height)] for outline, height in zip(outlines, heights, strict=True)]
    )


def sweep_outlines(path: npt.ArrayLike, outlines: Sequence[Array], up: Sequence[float], closed: bool = False) -> Array:
    """Return rings (m, n, 3): m outlines (n, 2) at places (m, 3) of a path, perpendicular to it.

    Their y axes point to `up` (3,) as far as the path allows.
    """
    points = np.asarray(path, dtype=float)
    tangents = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0) if closed else np.gradient(points, axis=0)
    side = np.cross(tangents, np.asarray(up, dtype=float))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    lift = np.cross(side, tangents)
    lift /= np.linalg.norm(lift, axis=1, keepdims=True)
    return np.stack(
        [
            point + outline[:, :1] * x + outline[:, 1:] * y
            for point, outline, x, y in zip(points, outlines, side, lift, strict=True)
        ]
    )


def make_bar(edges: npt.ArrayLike, low: float, high: float, bevel: float = 2.0) -> Array:
    """Return rings (m, 8, 3) of a flat bar in the xy plane, with bevelled edges, between two heights z.

    `edges` (m, 2, 2) are the positions xy of both edges at stations along the bar.
    """
    stations = np.asarray(edges, dtype=float)
    across = stations[:, 1] - stations[:, 0]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rings = []
    for first, second, unit in zip(stations[:, 0], stations[:, 1], across, strict=True):
        cut = unit * bevel
        flat = [first + cut, second - cut, second, second, second - cut, first + cut, first, first]
        z = [low, low, low + bevel, high - bevel, high, high, high - bevel, low + bevel]
        rings.append(np.c_[np.array(flat), z])
    return np.stack(rings)


def loft(
    rings: Array,
    color: str | Sequence[str],
    breaks: Sequence[int] | None = (),
    closed: bool = False,
    collides: bool = True,
) -> Piece:
    """Return the closed surface through rings (m, n, 3) of the same winding, with one color or one for each band.

    The collision body is split into convex parts at the rings with the numbers `breaks`, or at every ring (None).
    """
    if closed:
        rings = np.concatenate([rings, rings[:1]])
    n_bands = len(rings) - 1
    colors = [color] * n_bands if isinstance(color, str) else list(color)
    faces: dict[str, list[Array]] = {}
    for band, name in enumerate(colors):
        faces.setdefault(name, []).append(_triangulate_band(rings[band], rings[band + 1]))
    if not closed:
        faces[colors[0]].append(_triangulate_cap(rings[0][::-1]))
        faces[colors[-1]].append(_triangulate_cap(rings[-1]))
    visual = tuple((name, _orient_outward(np.concatenate(parts), rings)) for name, parts in faces.items())
    cuts = range(len(rings)) if breaks is None else [0, *breaks, n_bands]
    parts = [make_hull(rings[start : stop + 1]) for start, stop in itertools.pairwise(cuts)]
    return Piece(visual, tuple(parts) if collides else ())


def stack(
    outlines: Iterable[Array], heights: Iterable[float], color: str | Sequence[str], breaks: Sequence[int] = ()
) -> Piece:
    """Return the closed surface through outlines (n, 2) at heights z, see `loft`."""
    return loft(stack_outlines(outlines, heights), color, breaks)


def revolve_wall(stations: npt.ArrayLike, color: str, n: int = 48, n_parts: int = 20) -> Piece:
    """Return a thin wall as a surface of revolution about the z axis, with `n` sides.

    `stations` (k, 4) are outer radius and z, then inner radius and z at k places along the wall. Each of the
    `n_parts` sectors of the collision body has k - 1 convex parts.
    """
    table = np.asarray(stations, dtype=float)
    visual = loft(_revolve(np.concatenate([table[:, :2], table[::-1, 2:]]), n), color, closed=True, collides=False)
    parts = []
    for lower, upper in itertools.pairwise(table):
        sectors = _revolve(np.stack([lower[:2], upper[:2], upper[2:], lower[2:]]), n_parts)
        parts += [make_hull(np.stack([sectors[k], sectors[(k + 1) % n_parts]])) for k in range(n_parts)]
    return Piece(visual.visual, tuple(parts))


def make_block(size: Sequence[float], color: str, corner: float = 1.5) -> Piece:
    """Return a box at the origin, with vertical edges of radius `corner` and horizontal bevels of that width."""
    x, y, z = size
    full, inset = make_rectangle(x, y, corner), make_rectangle(x - 2 * corner, y - 2 * corner, corner * 0.5)
    heights = (-z / 2, -z / 2 + corner, z / 2 - corner, z / 2)
    return stack([inset, full, full, inset], heights, color)


def make_label(low: Sequence[float], high: Sequence[float], color: str) -> Piece:
    """Return a box without collision body from its lowest to its highest corner, such as a label on a surface."""
    outline = make_rectangle(high[0] - low[0], high[1] - low[1], 0.05, 2)
    center = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0]
    return loft(stack_outlines([outline, outline], (low[2], high[2])), color, collides=False).transform(center)


def make_hull(points: Array) -> trimesh.Trimesh:
    """Return the convex hull of points (..., 3)."""
    body: trimesh.Trimesh = trimesh.convex.convex_hull(points.reshape(-1, 3))
    return body


def _revolve(section: Array, n: int) -> Array:
    angle = np.arange(n) * 2 * np.pi / n
    radius, height = section[:, 0], section[:, 1]
    return np.stack(
        [np.stack([radius * np.cos(a), radius * np.sin(a), height], axis=1) for a in angle],
    )


def _triangulate_band(lower: Array, upper: Array) -> Array:
    ahead_lower, ahead_upper = np.roll(lower, -1, axis=0), np.roll(upper, -1, axis=0)
    first = np.stack([lower, ahead_lower, ahead_upper], axis=1)
    second = np.stack([lower, ahead_upper, upper], axis=1)
    return np.concatenate([first, second])


def _triangulate_cap(ring: Array) -> Array:
    center = np.broadcast_to(ring.mean(axis=0), ring.shape)
    return np.stack([center, ring, np.roll(ring, -1, axis=0)], axis=1)


def _orient_outward(triangles: Array, rings: Array) -> trimesh.Trimesh:
    """Return a mesh of triangles (k, 3, 3) whose normals point outwards."""
    first, second = rings[0], rings[1]
    corner = first.mean(axis=0)
    normal = sum(np.cross(a - corner, b - corner) for a, b in zip(first, np.roll(first, -1, axis=0), strict=True))
    if np.dot(normal, second.mean(axis=0) - corner) < 0:
        triangles = triangles[:, ::-1]
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    mesh.merge_vertices()
    return mesh
