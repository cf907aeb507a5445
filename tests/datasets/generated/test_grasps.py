"""Tests of shapes of procedural objects, and of human and robot grasps of them."""

import numpy as np
import pytest

from handover_marl.assets.hand_model import SUBJECT_SIZES, scale_hand
from handover_marl.datasets.generated.config import OBJECT_KINDS
from handover_marl.datasets.generated.grasps import draw_human_grasps, draw_robot_grasps
from handover_marl.datasets.generated.objects import ProceduralObject, draw_object
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import Solid, make_surface


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
