"""Building blocks of the object models: lofted surfaces with their convex collision parts.

Lengths in the `shapes*` modules are millimetres, as in the tables of measurements they hold; `build_objects` turns
them into metres. An outline is an array (n, 2), a ring an outline placed in space (n, 3), a loft a surface through
consecutive rings.
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
    """A part of an object.

    Attributes:
        visual: (colour name, surface) pairs.
        collision: Convex bodies; together they fill the piece. Empty for what only shows, such as a label.
    """

    visual: tuple[tuple[str, trimesh.Trimesh], ...]
    collision: tuple[trimesh.Trimesh, ...] = ()

    def moved(self, offset: Sequence[float] = (0, 0, 0), rotation_degrees: Sequence[float] = (0, 0, 0)) -> "Piece":
        """This piece turned about the origin by a rotation vector (degrees), then shifted by `offset`."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(rotation_degrees, degrees=True).as_matrix()
        matrix[:3, 3] = offset
        return Piece(
            tuple((colour, mesh.copy().apply_transform(matrix)) for colour, mesh in self.visual),
            tuple(mesh.copy().apply_transform(matrix) for mesh in self.collision),
        )


def ellipse(half_x: float, half_y: float | None = None, n: int = 32, exponent: float = 2.0) -> Array:
    """Outline |x/half_x|^exponent + |y/half_y|^exponent = 1; above 2 it nears a rectangle with round corners."""
    angle = np.arange(n) * 2 * np.pi / n
    cosine, sine = np.cos(angle), np.sin(angle)
    radius = (np.abs(cosine) ** exponent + np.abs(sine) ** exponent) ** (-1 / exponent)
    return np.stack([half_x * radius * cosine, (half_x if half_y is None else half_y) * radius * sine], axis=1)


def rectangle(size_x: float, size_y: float, corner: float, n_corner: int = 4) -> Array:
    """Outline of a rectangle whose corners are rounded with radius `corner`."""
    arc = np.linspace(0, np.pi / 2, n_corner)
    rounded = []
    for quarter, (sign_x, sign_y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        centre = np.array([sign_x * (size_x / 2 - corner), sign_y * (size_y / 2 - corner)])
        angle = arc + quarter * np.pi / 2
        rounded.append(centre + corner * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(rounded)


def span(low: Sequence[float], high: Sequence[float], corner: float = 0.0, exponent: float = 0.0) -> Array:
    """Outline between two corners of its bounding box: superelliptic if `exponent` is given, else a rectangle."""
    lower, upper = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    x, y = (upper - lower).tolist()
    outline = ellipse(x / 2, y / 2, exponent=exponent) if exponent else rectangle(x, y, corner)
    centred: Array = outline + (lower + upper) / 2
    return centred


def stack(outlines: Iterable[Array], heights: Iterable[float]) -> Array:
    """Rings (m, n, 3): outlines laid over each other along z."""
    return np.stack(
        [np.c_[outline, np.full(len(outline), height)] for outline, height in zip(outlines, heights, strict=True)]
    )


def follow(path: npt.ArrayLike, outlines: Sequence[Array], up: Sequence[float], closed: bool = False) -> Array:
    """Rings (m, n, 3) across a path (m, 3): the outline's x points to the path's side, its y along `up`."""
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


def strip(edges: npt.ArrayLike, low: float, high: float, bevel: float = 2.0) -> Array:
    """Rings (m, 8, 3) of a flat bar lying in the xy plane.

    Args:
        edges: (m, 2, 2) stations along the bar, each the xy of its one edge and of its other.
        low: Lower face, z.
        high: Upper face, z.
        bevel: How much is cut off the four long edges.
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
    colour: str | Sequence[str],
    breaks: Sequence[int] | None = (),
    closed: bool = False,
    collides: bool = True,
) -> Piece:
    """The closed surface through consecutive convex rings.

    Args:
        rings: (m, n, 3), wound the same way.
        colour: One colour, or one for each of the bands between rings.
        breaks: Rings at which the collision body is cut; each stretch between cuts becomes one convex part. None
            cuts at every ring.
        closed: Whether the last ring joins the first, as in a loop.
        collides: Whether there is a collision body at all.
    """
    if closed:
        rings = np.concatenate([rings, rings[:1]])
    n_bands = len(rings) - 1
    colours = [colour] * n_bands if isinstance(colour, str) else list(colour)
    faces: dict[str, list[Array]] = {}
    for band, name in enumerate(colours):
        faces.setdefault(name, []).append(_band(rings[band], rings[band + 1]))
    if not closed:
        faces[colours[0]].append(_cap(rings[0][::-1]))
        faces[colours[-1]].append(_cap(rings[-1]))
    visual = tuple((name, _outward(np.concatenate(parts), rings)) for name, parts in faces.items())
    cuts = range(len(rings)) if breaks is None else [0, *breaks, n_bands]
    parts = [hull(rings[start : stop + 1]) for start, stop in itertools.pairwise(cuts)]
    return Piece(visual, tuple(parts) if collides else ())


def revolved_wall(stations: npt.ArrayLike, colour: str, n: int = 48, n_parts: int = 20) -> Piece:
    """A thin wall turned about the z axis.

    Args:
        stations: (m, 4) from one end of the wall to the other: outer radius and z, inner radius and z.
        colour: Its colour.
        n: Sides of the visual mesh.
        n_parts: Sectors of the collision body; every one has m - 1 convex parts.
    """
    table = np.asarray(stations, dtype=float)
    visual = loft(_turned(np.concatenate([table[:, :2], table[::-1, 2:]]), n), colour, closed=True, collides=False)
    parts = []
    for lower, upper in itertools.pairwise(table):
        sectors = _turned(np.stack([lower[:2], upper[:2], upper[2:], lower[2:]]), n_parts)
        parts += [hull(np.stack([sectors[k], sectors[(k + 1) % n_parts]])) for k in range(n_parts)]
    return Piece(visual.visual, tuple(parts))


def block(size: Sequence[float], colour: str, corner: float = 1.5) -> Piece:
    """A box centred at the origin with rounded vertical and bevelled horizontal edges."""
    x, y, z = size
    full, inset = rectangle(x, y, corner), rectangle(x - 2 * corner, y - 2 * corner, corner * 0.5)
    heights = (-z / 2, -z / 2 + corner, z / 2 - corner, z / 2)
    return loft(stack([inset, full, full, inset], heights), colour)


def label(low: Sequence[float], high: Sequence[float], colour: str) -> Piece:
    """A flat box that only shows."""
    outline = rectangle(high[0] - low[0], high[1] - low[1], 0.05, 2)
    centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0]
    return loft(stack([outline, outline], (low[2], high[2])), colour, collides=False).moved(centre)


def hull(points: Array) -> trimesh.Trimesh:
    """The convex hull of points (..., 3)."""
    body: trimesh.Trimesh = trimesh.convex.convex_hull(points.reshape(-1, 3))
    return body


def _turned(section: Array, n: int) -> Array:
    angle = np.arange(n) * 2 * np.pi / n
    radius, height = section[:, 0], section[:, 1]
    return np.stack(
        [np.stack([radius * np.cos(a), radius * np.sin(a), height], axis=1) for a in angle],
    )


def _band(lower: Array, upper: Array) -> Array:
    ahead_lower, ahead_upper = np.roll(lower, -1, axis=0), np.roll(upper, -1, axis=0)
    first = np.stack([lower, ahead_lower, ahead_upper], axis=1)
    second = np.stack([lower, ahead_upper, upper], axis=1)
    return np.concatenate([first, second])


def _cap(ring: Array) -> Array:
    centre = np.broadcast_to(ring.mean(axis=0), ring.shape)
    return np.stack([centre, ring, np.roll(ring, -1, axis=0)], axis=1)


def _outward(triangles: Array, rings: Array) -> trimesh.Trimesh:
    """A mesh of triangles (k, 3, 3) whose normals point away from the ring's inside."""
    first, second = rings[0], rings[1]
    corner = first.mean(axis=0)
    normal = sum(np.cross(a - corner, b - corner) for a, b in zip(first, np.roll(first, -1, axis=0), strict=True))
    if np.dot(normal, second.mean(axis=0) - corner) < 0:
        triangles = triangles[:, ::-1]
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    mesh.merge_vertices()
    return mesh
