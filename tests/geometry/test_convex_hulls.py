"""Tests of convex hulls and of hulls with few vertices."""

import numpy as np
import pytest

from handover_marl.geometry.model_files.meshes import compute_convex_hull, select_extreme_points


@pytest.mark.parametrize("n", [4, 8, 60, 400])
def test_hulls_contain_all_points_and_hardly_shrink(n: int) -> None:
    points = np.random.default_rng(n).normal(size=(n, 3))
    kept = select_extreme_points(points, 64)
    assert len(kept) <= 64
    assert {tuple(point) for point in kept} <= {tuple(point) for point in points}
    assert (np.ptp(kept, axis=0) > 0.9 * np.ptp(points, axis=0)).all()
    corners, faces = compute_convex_hull(points)
    first, second, third = (corners[faces[:, corner]] for corner in range(3))
    heights = np.einsum("fi,fni->fn", np.cross(second - first, third - first), points[None] - first[:, None])
    assert heights.max() < 1e-9, "nothing lies outside of any face"
    # In a closed surface, every edge occurs once in each direction.
    edges = [(a, b) for face in faces.tolist() for a, b in zip(face, [*face[1:], face[0]], strict=True)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
