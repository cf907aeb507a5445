import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from handover_marl.datasets.generated.shapes import Part, Solid, make_surface
from handover_marl.datasets.synthetic.random_stream import RandomStream

lengths = st.floats(0.01, 0.1)


@st.composite
def parts(draw: st.DrawFn) -> Part:
    kind = draw(st.sampled_from(["box", "cone", "superellipsoid"]))
    size = (draw(lengths), draw(lengths), draw(lengths))
    exponents = (draw(st.floats(0.3, 1.0)), draw(st.floats(0.3, 1.0)))
    offset = (draw(st.floats(-0.1, 0.1)), 0.02, -0.01)
    return Part(kind, size, "red", draw(st.sampled_from([0.0, 0.002])), exponents, offset, draw(st.integers(0, 2)))


@settings(max_examples=40)
@given(part=parts())
def test_surface_is_the_convex_hull_of_its_vertices(part: Part) -> None:
    surface = make_surface(part)
    corners = surface.vertices[surface.faces]
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    hull = ConvexHull(surface.vertices)
    assert volume == pytest.approx(hull.volume, rel=1e-9)  # The surface is closed and all faces point outwards.
    assert (surface.vertices @ surface.normals.T <= surface.offsets + 1e-9).all()


@settings(max_examples=40)
@given(part=parts(), seed=st.integers(0, 1000))
def test_distances_agree_with_the_surface(part: Part, seed: int) -> None:
    surface = make_surface(part)
    vertices = surface.vertices[:-2]  # The last two vertices are the centers of the part's ends.
    assert np.abs(part.compute_distances(vertices)).max() < 0.0015
    points = np.random.default_rng(seed).uniform(-0.25, 0.25, (200, 3)) + part.position
    distances = part.compute_distances(points)
    inside = (points @ surface.normals.T < surface.offsets).all(axis=1)
    assert (distances[inside] < 0.0015).all()
    # Distances never exceed those to the vertices, which are on the surface.
    nearest = np.linalg.norm(points[:, None] - vertices, axis=2).min(axis=1)
    assert (distances < nearest + 0.0015).all()
    outside = (points @ surface.normals.T - surface.offsets).max(axis=1)
    assert (distances[~inside] > -0.006).all()
    assert (nearest >= outside - 1e-9).all()


def test_rays_leave_at_the_opposite_side() -> None:
    surface = make_surface(Part("box", (0.02, 0.03, 0.04), "red"))
    lengths, normals = surface.find_exits(np.array([[-0.02, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]]))
    assert lengths == pytest.approx([0.04])
    assert normals == pytest.approx(np.array([[1.0, 0.0, 0.0]]))


def test_opposite_points_are_on_the_outer_surface() -> None:
    body, neck = Part("cone", (0.03, 0.03, 0.05), "red"), Part("cone", (0.01, 0.01, 0.04), "blue")
    solid = Solid((body, neck.move([0.0, 0.0, 0.06])))
    first, second, cosines = solid.sample_opposite_points(RandomStream(3), 400, 0.1, 0.1)
    assert 100 < len(first) < 400
    for points in (first, second):
        assert np.abs(solid.compute_distances(points)).max() < 0.001
    assert (np.linalg.norm(second - first, axis=1) < 0.1).all()
    assert (cosines > 0.0).all()
    mirrored, _, _ = solid.mirror().sample_opposite_points(RandomStream(3), 400, 0.1, 0.1)
    np.testing.assert_array_equal(mirrored, first * [-1.0, 1.0, 1.0])


def test_normals_point_outwards() -> None:
    solid = Solid((Part("superellipsoid", (0.03, 0.03, 0.03), "red"),))
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(solid.compute_normals(0.031 * directions), directions, atol=1e-3)
