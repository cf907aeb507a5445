import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.assets.shipped import find_object_urdf
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import Part, Solid, make_surface, read_solid

igl = pytest.importorskip("igl")

lengths = st.floats(0.01, 0.1)


@st.composite
def parts(draw: st.DrawFn) -> Part:
    kind = draw(st.sampled_from(["box", "cone", "superellipsoid"]))
    size = (draw(lengths), draw(lengths), draw(lengths))
    exponents = (draw(st.floats(0.3, 1.0)), draw(st.floats(0.3, 1.0)))
    offset = (draw(st.floats(-0.1, 0.1)), 0.02, -0.01)
    return Part(kind, size, "red", draw(st.sampled_from([0.0, 0.002])), exponents, offset, draw(st.integers(0, 2)))


@settings(max_examples=40)
@given(part=parts(), seed=st.integers(0, 1000))
def test_distances_are_those_to_the_surface(part: Part, seed: int) -> None:
    """Distances are exact inside, and positive and never too large outside."""
    surface = make_surface(part)
    points = np.random.default_rng(seed).uniform(-0.25, 0.25, (200, 3)) + part.position
    distances = Solid([surface]).compute_distances(points)
    exact = igl.signed_distance(points, surface.vertices, surface.faces)[0]
    np.testing.assert_allclose(distances[exact < 0.0], exact[exact < 0.0], atol=1e-6)
    outside = exact >= 0.0
    assert (distances[outside] <= exact[outside] + 1e-6).all()
    assert (distances[outside] >= -1e-6).all()


def test_opposite_points_are_on_the_outer_surface() -> None:
    body, neck = Part("cone", (0.03, 0.03, 0.05), "red"), Part("cone", (0.01, 0.01, 0.04), "blue")
    solid = Solid([make_surface(body), make_surface(neck.move([0.0, 0.0, 0.06]))])
    first, second, cosines = solid.sample_opposite_points(RandomStream(3), 400, 0.1, 0.1)
    assert 100 < len(first) < 400
    for points in (first, second):
        np.testing.assert_allclose(solid.compute_distances(points), 0.0, atol=1e-9)
    assert (np.linalg.norm(second - first, axis=1) < 0.1).all()
    assert (cosines > 0.0).all()
    mirrored, _, _ = solid.mirror().sample_opposite_points(RandomStream(3), 400, 0.1, 0.1)
    np.testing.assert_allclose(solid.compute_distances(mirrored * [-1.0, 1.0, 1.0]), 0.0, atol=1e-9)


def test_a_cup_is_spanned_and_pinched() -> None:
    """Opposite points of a shipped bowl are at its wall or on both sides of it, and none is between adjoining parts."""
    solid = read_solid(find_object_urdf("024_bowl"))
    first, second, _ = solid.sample_opposite_points(RandomStream(3), 3000, 0.2, 0.02)
    widths = np.linalg.norm(second - first, axis=1)
    assert (widths < 0.02).any()
    assert (widths > 0.1).any()
    beyond = 1e-5 * (second - first) / widths[:, None]
    assert (solid.compute_distances(np.stack([first - beyond, second + beyond])) > 0.0).all()
