"""Tests of shapes of procedural objects, and of human and robot grasps of them."""

import numpy as np
import pytest

from handover_marl.assets.hand_model import SUBJECT_SIZES, scale_hand
from handover_marl.assets.shipped import find_object_urdf
from handover_marl.datasets.generated.config import OBJECT_KINDS
from handover_marl.datasets.generated.hands import Palms, make_hand_templates
from handover_marl.datasets.generated.human_grasps import draw_human_grasps, find_free_hands
from handover_marl.datasets.generated.objects import ProceduralObject, draw_object
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.robot_grasps import draw_robot_grasps
from handover_marl.datasets.generated.shapes import Part, Solid, make_surface, read_solid


def draw_kind(kind: str, seed: int) -> tuple[ProceduralObject, Solid]:
    item = draw_object(RandomStream(seed), tuple(float(kind == other) for other in OBJECT_KINDS))
    return item, Solid(map(make_surface, item.parts))


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_objects_are_centered_and_graspable(kind: str) -> None:
    for seed in range(8):
        item, solid = draw_kind(kind, seed)
        low, high = solid.corners.min(axis=0), solid.corners.max(axis=0)
        assert item.kind == kind
        assert np.abs(low + high).max() < 2e-4
        assert (high - low).min() < 0.08
        assert 0.05 < (high - low).max() < 0.30
        assert len(item.up_axes) == 6
        assert sum(item.up_axes) > 0.0


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_human_hands_hold_objects(kind: str) -> None:
    (item, solid), size = draw_kind(kind, 4), SUBJECT_SIZES[5]
    for side in ("left", "right"):
        grasps = draw_human_grasps(RandomStream(1), solid, item.up_axes, size, side)
        assert grasps is not None
        assert (np.diff(grasps.wrist_distance) >= 0.0).all()
        assert grasps.touching[:, 4].all()
        assert (grasps.touching[:, :4].sum(axis=1) >= 2).all()
        assert (grasps.overlap < 0.004).all()
        # Grasps of both sides are in the object's frame, not mirrored: joints are outside, fingertips near.
        distances = solid.compute_distances(scale_hand(size, side).compute_keypoints(grasps.compute_hand_dof()))
        assert distances.min() > -0.004
        assert (distances[:, 8::4].min(axis=1) < 0.02).all()


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_robot_grasps_span_the_object(kind: str) -> None:
    _, solid = draw_kind(kind, 2)
    grasps = draw_robot_grasps(RandomStream(5), solid)
    assert 10 < len(grasps) <= 60
    rotations = grasps[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (len(grasps), 1, 1)), atol=1e-6)
    # The object is between the pads, which are outside of it.
    middle = grasps[:, None, :3, 3] + np.linspace(0.08, 0.112, 9)[:, None] * grasps[:, None, :3, 2]
    assert (solid.compute_distances(middle).min(axis=1) < 0.0).all()
    for sign in (-0.041, 0.041):
        assert (solid.compute_distances(middle + sign * grasps[:, None, :3, 0]) > 0.0).all()


def test_hands_without_a_free_posture() -> None:
    """Hands inside a body have no free posture, which is not an error, and hands far away from it all have one."""
    body = Solid([make_surface(Part("box", (1.0, 1.0, 1.0), "red"))])
    templates, rows = make_hand_templates(SUBJECT_SIZES[3]), np.arange(5)
    palms = Palms(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)))
    assert len(find_free_hands(body, templates, palms, rows)) == 0
    far = Palms(np.full((5, 3), 5.0), palms.rotation)
    assert find_free_hands(body, templates, far, rows).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("kind", ["box", "cone", "superellipsoid"])
@pytest.mark.parametrize("axis", range(3))
def test_distances_are_those_to_the_surface(kind: str, axis: int) -> None:
    """Distances are exact inside, and positive and never too large outside."""
    igl = pytest.importorskip("igl")
    rng = np.random.default_rng(axis)
    for rounding in (0.0, 0.002):
        size, exponents = tuple(rng.uniform(0.02, 0.1, 3)), tuple(rng.uniform(0.3, 1.0, 2))
        surface = make_surface(Part(kind, size, "red", rounding, exponents, (0.05, 0.02, -0.01), axis))
        points = rng.uniform(-0.25, 0.25, (200, 3)) * np.linspace(0.1, 1.0, 200)[:, None] + (0.05, 0.02, -0.01)
        distances = Solid([surface]).compute_distances(points)
        exact = igl.signed_distance(points, surface.vertices, surface.faces)[0]
        inside = exact < 0.0
        assert inside.sum() > 3
        np.testing.assert_allclose(distances[inside], exact[inside], atol=1e-6)
        assert (distances[~inside] <= exact[~inside] + 1e-6).all()
        assert (distances[~inside] >= -1e-6).all()


def test_opposite_points_are_on_the_outer_surface() -> None:
    body, neck = Part("cone", (0.03, 0.03, 0.05), "red"), Part("cone", (0.01, 0.01, 0.04), "blue")
    solid = Solid([make_surface(body), make_surface(neck.move([0.0, 0.0, 0.06]))])
    first, second, cosines = solid.sample_opposite_points(RandomStream(3), 400, 0.1, 0.1)
    assert 100 < len(first) < 400
    np.testing.assert_allclose(solid.compute_distances(np.stack([first, second])), 0.0, atol=1e-9)
    assert (np.linalg.norm(second - first, axis=1) < 0.1).all()
    assert (cosines > 0.0).all()
    mirrored, _, _ = solid.mirror().sample_opposite_points(RandomStream(3), 400, 0.1, 0.1)
    np.testing.assert_allclose(solid.compute_distances(mirrored * [-1.0, 1.0, 1.0]), 0.0, atol=1e-9)
    # A bowl is pinched at its wall and spanned, and no point is between adjoining parts.
    solid = read_solid(find_object_urdf("024_bowl"))
    first, second, _ = solid.sample_opposite_points(RandomStream(3), 3000, 0.2, 0.02)
    widths = np.linalg.norm(second - first, axis=1)
    assert (widths < 0.02).any()
    assert (widths > 0.1).any()
    beyond = 1e-5 * (second - first) / widths[:, None]
    assert (solid.compute_distances(np.stack([first - beyond, second + beyond])) > 0.0).all()
