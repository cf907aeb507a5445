import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

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
