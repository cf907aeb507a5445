"""Tests that the screen bounds of triangles contain every pixel whose ray, in double precision, hits a triangle."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.simulation.camera.screen_bounds import find_candidate_pixels, project_points, split_pixels_by_part

NEAR = 0.035
PIXELS = np.arange(224 * 224)
WAYS = np.stack([PIXELS % 224 - 112.0, PIXELS // 224 + 1 - 112.0, np.full(len(PIXELS), 112.0)], axis=1) / 112.0
#: Hits this near to an edge (share of the sides), or of triangles this nearly edge-on, are uncertain and not counted.
EDGE = 1e-6

Array = npt.NDArray[np.float32]
Faces = npt.NDArray[np.int32]
Pixels = npt.NDArray[np.int64]


def met(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return a mask of pixels whose rays hit a triangle's front beyond the near plane (Moeller and Trumbore, 1997)."""
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    across = np.cross(WAYS, second)
    determinant = across @ first
    # The determinant is positive if the ray meets the front of the triangle, against its normal.
    size = np.linalg.norm(first) * np.linalg.norm(second)
    front = determinant > EDGE * size
    divisor = np.where(front, determinant, 1.0)
    u = across @ -corners[0] / divisor
    along = np.cross(-corners[0], first)
    v, depth = WAYS @ along / divisor, second @ along / divisor
    return np.array(front & (u >= EDGE) & (v >= EDGE) & (u + v <= 1.0 - EDGE) & (depth > NEAR + 1e-6))


def mesh_met(points: Array, faces: Faces) -> Pixels:
    corners = points.astype(np.float64)[faces]
    return np.flatnonzero(np.any([met(triangle) for triangle in corners], axis=0))


def boxed(points: Array, margin: float) -> npt.NDArray[np.bool_]:
    """Return a mask of pixels in the bounding box of points before the camera, enlarged by a margin (pixels)."""
    x, y, z = points.astype(np.float64).T
    right, down = 112.0 + 112.0 * x / z, 111.0 + 112.0 * y / z
    columns, rows = PIXELS % 224, PIXELS // 224
    wide = (columns >= right.min() - margin) & (columns <= right.max() + margin)
    return np.array(wide & (rows >= down.min() - margin) & (rows <= down.max() + margin))


def check_form(pixels: Pixels) -> None:
    assert pixels.dtype == np.int64
    assert pixels.ndim == 1
    assert (np.diff(pixels) > 0).all(), "ascending, each once"
    assert ((pixels >= 0) & (pixels < 224 * 224)).all()


def check_nothing_is_missed(points: Array, faces: Faces) -> Pixels:
    pixels = find_candidate_pixels(points, faces)
    check_form(pixels)
    shown = mesh_met(points, faces)
    assert not np.setdiff1d(shown, pixels).size
    return shown


coordinates = st.floats(-1.0, 1.0, width=32)


def vectors(scale: float) -> st.SearchStrategy[list[float]]:
    return st.lists(st.floats(-scale, scale), min_size=3, max_size=3)


@st.composite
def triangles(draw: st.DrawFn) -> Array:
    """Draw a triangle (3, 3): anywhere, at the near plane, tiny, huge, edge-on, behind the camera or far aside."""
    kind = draw(st.sampled_from(["anywhere", "near plane", "tiny", "huge", "edgewise", "behind", "far aside"]))
    middle = np.array([draw(coordinates), draw(coordinates), draw(st.floats(-0.3, 2.0))])
    size = {"tiny": 3e-3, "huge": 100.0, "far aside": 0.3}.get(kind, 0.7)
    corners = middle + [draw(vectors(size)) for _ in range(3)]
    if kind == "near plane":
        corners *= 0.1
        corners[:, 2] = NEAR + 0.01 * (corners[:, 2] - 0.05)
    elif kind == "edgewise":
        # The corners lie almost in a plane through the pinhole.
        corners[2] = corners[0] * draw(st.floats(-1.0, 2.0)) + corners[1] * draw(st.floats(-1.0, 2.0))
        corners[2] += draw(vectors(draw(st.sampled_from([0.0, 1e-6, 1e-3]))))
    elif kind == "behind":
        corners[:, 2] = NEAR - np.abs(corners[:, 2])
    elif kind == "far aside":
        corners[:, 0] += draw(st.sampled_from([-3.0, 3.0]))
    return corners.astype(np.float32)


FACES = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)


@settings(max_examples=150)
@given(triangles(), st.sampled_from([0, 1]))
def test_no_pixel_of_a_triangle_is_missed(corners: Array, side: int) -> None:
    check_nothing_is_missed(corners, FACES[side : side + 1])


@settings(max_examples=30)
@given(st.lists(triangles(), min_size=2, max_size=5), st.integers(0, 2**32 - 1))
def test_no_pixel_of_a_mesh_is_missed(parts: list[Array], seed: int) -> None:
    """No pixel is missed if triangles of all kinds share corners and some corners belong to no triangle."""
    points = np.concatenate([*parts, np.zeros((1, 3), dtype=np.float32)])
    order = np.random.default_rng(seed).integers(0, len(points), (len(parts), 3))
    faces = np.concatenate([np.arange(3 * len(parts)).reshape(-1, 3), order]).astype(np.int32)
    check_nothing_is_missed(points, faces)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_a_front_face_is_bounded_by_its_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 0.3], [1, 1, 1.5], (3, 3)).astype(np.float32)
    corners = points.astype(np.float64)
    toward = np.linalg.det(corners) / np.abs(corners).max() ** 3
    faces = FACES[:1] if toward < 0.0 else FACES[1:]
    pixels = find_candidate_pixels(points, faces)
    check_form(pixels)
    assert np.isin(np.flatnonzero(boxed(points, 0.0)), pixels).all() or abs(toward) < 1e-4
    assert boxed(points, 0.02)[pixels].all()


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_back_faces_and_triangles_behind_have_no_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 0.3], [1, 1, 1.5], (3, 3)).astype(np.float32)
    away = np.linalg.det(points.astype(np.float64))
    if abs(away) > 1e-3:
        assert not len(find_candidate_pixels(points, FACES[:1] if away > 0.0 else FACES[1:]))
    points[:, 2] = NEAR - rng.uniform(1e-4, 2.0, 3)
    assert not len(find_candidate_pixels(points, FACES))


def test_a_triangle_covers_a_pixel_only_at_its_sample_position() -> None:
    def tiny(column: float, row: float) -> Array:
        places = np.array([[column - 0.1, row - 0.1], [column - 0.1, row + 0.1], [column + 0.1, row]])
        return np.array(np.c_[(places - (112.0, 111.0)) / 112.0, np.ones(3)], dtype=np.float32)

    for column, row in ((100, 50), (0, 0), (223, 223), (0, 223), (7, 0)):
        assert find_candidate_pixels(tiny(column, row), FACES).tolist() == [224 * row + column]
        assert not len(find_candidate_pixels(tiny(column + 0.5, row), FACES))
        assert not len(find_candidate_pixels(tiny(column, row + 0.5), FACES))


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_pixels_at_vertices_are_covered(seed: int) -> None:
    """A pixel whose ray passes through a vertex is covered despite the rounding to float32."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, len(PIXELS), 3)
    points = (WAYS[pixels] * rng.uniform(0.04, 2.0, (3, 1))).astype(np.float32)
    assert np.isin(pixels, find_candidate_pixels(points, FACES)).all()
    assert np.isin(np.sort(pixels), split_pixels_by_part(PIXELS, [points])[0]).all()


@pytest.mark.parametrize("depth", [0.036, 1.0, 1.9])
def test_a_wall_covers_the_image(depth: float) -> None:
    wall = np.array([[-9, -9, depth], [9, -9, depth], [0, 19, depth]], dtype=np.float32)
    np.testing.assert_array_equal(find_candidate_pixels(wall, FACES), PIXELS)


def test_a_floor_through_the_near_plane_covers_the_lower_half() -> None:
    floor = np.array([[0.0, 0.2, -50.0], [50.0, 0.2, 50.0], [-50.0, 0.2, 50.0]], dtype=np.float32)
    shown = check_nothing_is_missed(floor, FACES)
    assert set((shown // 224).tolist()) == set(range(112, 224))


@settings(max_examples=40)
@given(st.lists(triangles(), min_size=1, max_size=6))
def test_many_triangles_have_the_pixels_of_each(parts: list[Array]) -> None:
    points = np.concatenate(parts)
    faces = np.arange(len(points)).reshape(-1, 3).astype(np.int32)
    single = [find_candidate_pixels(part, FACES[:1]) for part in parts]
    np.testing.assert_array_equal(find_candidate_pixels(points, faces), np.unique(np.concatenate(single)))


def test_no_triangles_have_no_pixels() -> None:
    for points in (np.zeros((0, 3), dtype=np.float32), np.eye(3, dtype=np.float32), np.ones((3, 3), dtype=np.float32)):
        pixels = find_candidate_pixels(points, np.zeros((0, 3), dtype=np.int32))
        check_form(pixels)
        assert not len(pixels)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_points_project_to_sample_positions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, len(PIXELS), 20)
    points = (WAYS[pixels] * rng.uniform(NEAR, 2.0, (20, 1))).astype(np.float32)
    expected = np.stack([pixels % 224, pixels // 224], axis=1)
    np.testing.assert_allclose(project_points(points), expected, atol=1e-4)


@settings(max_examples=40)
@given(st.lists(triangles(), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_no_part_loses_a_visible_pixel(parts: list[Array], seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = np.flatnonzero(rng.random(len(PIXELS)) < rng.choice([0.0, 0.1, 1.0]))
    shares = split_pixels_by_part(pixels, parts)
    assert len(shares) == len(parts)
    for part, share in zip(parts, shares, strict=True):
        check_form(share)
        assert np.isin(share, pixels).all()
        shown = np.union1d(mesh_met(part, FACES[:1]), mesh_met(part, FACES[1:]))
        assert not np.setdiff1d(np.intersect1d(shown, pixels), share).size


@settings(max_examples=60)
@given(st.lists(triangles(), min_size=1, max_size=5))
def test_parts_get_the_pixels_of_their_boxes(parts: list[Array]) -> None:
    for part, share in zip(parts, split_pixels_by_part(PIXELS, parts), strict=True):
        if part[:, 2].min() < NEAR:
            np.testing.assert_array_equal(share, PIXELS)
        elif np.abs(part).max() < 2.0:
            assert boxed(part, 0.02)[share].all()
            assert np.isin(np.flatnonzero(boxed(part, 0.0)), share).all()
