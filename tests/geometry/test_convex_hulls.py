"""Tests of convex hulls and of hulls with few vertices."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.geometry.model_files.meshes import compute_convex_hull, select_extreme_points


@given(st.integers(0, 2**32 - 1), st.integers(8, 400))
def test_a_hull_of_few_points_hardly_shrinks(seed: int, n: int) -> None:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    kept = select_extreme_points(points, 64)
    assert len(kept) <= 64
    assert {tuple(point) for point in kept} <= {tuple(point) for point in points}
    spread = np.ptp(points, axis=0)
    assert (np.ptp(kept, axis=0) > 0.9 * spread).all()


@given(st.integers(0, 2**32 - 1), st.integers(4, 100))
def test_a_hull_contains_all_points_and_faces_outwards(seed: int, n: int) -> None:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    corners, faces = compute_convex_hull(points)
    first, second, third = (corners[faces[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    heights = np.einsum("fi,fni->fn", normals, points[None] - first[:, None])
    assert heights.max() < 1e-9, "nothing lies outside of any face"
    # In a closed surface, every edge occurs once in each direction.
    edges = [(a, b) for face in faces.tolist() for a, b in zip(face, [*face[1:], face[0]], strict=True)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
