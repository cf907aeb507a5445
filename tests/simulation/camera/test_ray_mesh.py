"""Tests of ray casting on boxes and squares, whose exact depths follow from the positions of their sides."""

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.simulation.camera.ray_body import RayHits, RayMesh

Array = npt.NDArray[np.float32]

FAR = np.float32(1e3)
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
# The corners of each side are counterclockwise as seen from outside.
_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_FACES = np.array([face for a, b, c, d in _SIDES for face in ((a, b, c), (a, c, d))], dtype=np.int32)

seeds = st.integers(0, 2**32 - 1)


def boxes(*halves: float) -> RayMesh:
    """Return a mesh of nested boxes with the given distances from the centre to the sides (m)."""
    vertices = np.concatenate([half * _CORNERS for half in halves]).astype(np.float32)
    return RayMesh(vertices, np.concatenate([_FACES + 8 * number for number in range(len(halves))]))


def sheets(*depths: float, backs: tuple[float, ...] = ()) -> RayMesh:
    """Return a mesh of squares across the z axis, visible from below at `depths` and from above at `backs`."""
    places = [*depths, *backs]
    square = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]], dtype=np.float64)
    vertices = np.concatenate([np.c_[square, np.full(4, depth)] for depth in places]).astype(np.float32)
    front = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    kinds = [front] * len(depths) + [front[:, ::-1]] * len(backs)
    return RayMesh(vertices, np.concatenate([face + 4 * number for number, face in enumerate(kinds)]))


def cast(mesh: RayMesh, start: object, ways: object, begin: float = 0.0, ends: object = FAR) -> RayHits:
    way = np.atleast_2d(np.asarray(ways, dtype=np.float32))
    end = np.broadcast_to(np.asarray(ends, dtype=np.float32), len(way))
    return mesh.cast_rays(np.asarray(start, dtype=np.float32), way, begin, end.copy())


def into_box(start: npt.NDArray[np.float64], ways: npt.NDArray[np.float64], half: float) -> npt.NDArray[np.float64]:
    """Return depths (n,) at which rays enter a box from outside, in units of their directions; nan if they do not."""
    one, other = (-half - start) / ways, (half - start) / ways
    into, out = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((into < out) & (into > 0.0), into, np.nan)


def random_rays(rng: np.random.Generator, count: int) -> npt.NDArray[np.float64]:
    """Return random directions (count, 3) of different lengths."""
    return np.array(rng.normal(size=(count, 3)) * rng.uniform(0.3, 3.0, (count, 1)))


def check_hits(hits: RayHits, expected: npt.NDArray[np.float64], clear: npt.NDArray[np.bool_]) -> None:
    """Check that no ray has two hits and that `clear` rays have the expected depths, or no hit where that is nan."""
    assert len(np.unique(hits.ray)) == len(hits.ray)
    depths = np.full(len(expected), np.nan)
    depths[hits.ray] = hits.depth
    assert hits.depth.dtype == np.float32
    np.testing.assert_allclose(depths[clear], expected[clear], rtol=1e-5, atol=3e-5)


@settings(max_examples=15)
@given(seeds)
def test_the_outer_of_nested_boxes_is_hit(seed: int) -> None:
    """Rays that start outside of nested boxes, or between two of them, hit the first box that they enter."""
    rng = np.random.default_rng(seed)
    halves = np.cumsum(rng.uniform(0.1, 0.5, 3))
    start = rng.uniform(-1.2, 1.2, 3) * halves[-1]
    ways = random_rays(rng, 200)
    aimed = rng.random(200) < 0.7
    ways[aimed] = rng.uniform(-1.0, 1.0, (200, 3))[aimed] * halves[-1] - start
    # Depths of rays almost parallel to a side are inaccurate.
    ways[np.abs(ways) < 0.05] = 0.05
    outside = [half for half in halves if np.abs(start).max() > half]
    depths = [into_box(start, ways, half) for half in outside]
    expected = np.fmin.reduce([np.full(200, np.nan), *depths])
    # Rays that graze an edge may hit it or not.
    grazed = [np.isnan(into_box(start, ways, half * grown)) for half in outside for grown in (0.999, 1.001)]
    pairs = zip(grazed[::2], grazed[1::2], strict=True)
    clear = np.all([np.ones(200, dtype=bool), *(one == other for one, other in pairs)], axis=0)
    check_hits(cast(boxes(*halves), start, ways), expected, clear)


@settings(max_examples=5)
@given(seeds)
def test_a_closed_box_is_invisible_from_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.01, 2.0)
    start = rng.uniform(-0.99, 0.99, 3) * half
    hits = cast(boxes(half), start, random_rays(rng, 200))
    assert not len(hits.ray)
    assert (hits.depth.shape, hits.face.shape) == ((0,), (0,))


def test_objects_are_visible_through_back_faces() -> None:
    around = boxes(0.1, 0.2, 0.3, 0.4)
    vertices = np.concatenate([around.vertices, np.array([[-9, -9, 2], [9, -9, 2], [0, 9, 2]], dtype=np.float32)])
    mesh = RayMesh(vertices, np.concatenate([around.faces, np.array([[32, 34, 33]], dtype=np.int32)]))
    hits = cast(mesh, [0, 0, 0], [[0, 0, 1], [0, 0.1, 1], [0, 0, -1], [1, 0, 0]])
    assert hits.ray.tolist() == [0, 1]
    assert hits.face.tolist() == [48, 48]
    np.testing.assert_allclose(hits.depth, 2.0, rtol=1e-6)
    many = sheets(1.5, backs=tuple(np.linspace(0.1, 1.0, 31)))
    np.testing.assert_allclose(cast(many, [0, 0, 0], [[0, 0, 1], [0.1, 0.2, 1]]).depth, [1.5, 1.5], rtol=1e-5)


def test_hits_outside_of_the_limits_are_ignored() -> None:
    mesh = sheets(1.0, 2.0)
    np.testing.assert_allclose(cast(mesh, [0, 0, 0], [0, 0, 1], 1.001).depth, [2.0], rtol=1e-6)
    assert not len(cast(mesh, [0, 0, 0], [0, 0, 1], 2.001).ray)
    # A ray whose near limit is inside a box passes through the back faces of the box.
    assert not len(cast(boxes(1.0), [0.1, 0.2, -2.0], [0, 0, 1], 1.5).ray)
    # The near limit is in units of the direction, which is twice as long here.
    np.testing.assert_allclose(cast(mesh, [0, 0, 0], [0, 0, 2], 0.501).depth, [1.0], rtol=1e-6)
    ends = [0.99, 1.01, 0.1, 0.35, 0.5, 5.0, 0.01, -1.0]
    hits = cast(sheets(1.0, 2.0, backs=(0.2, 0.999)), [0, 0, 0], np.tile([0.0, 0.0, 1.0], (8, 1)), 0.035, ends)
    assert sorted(hits.ray.tolist()) == [1, 5]
