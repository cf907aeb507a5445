import numpy as np
import pytest

from handover_marl.assets.anthropometry import SUBJECT_SIZES
from handover_marl.assets.hand_model import Side, scale_hand
from handover_marl.datasets.generated.config import OBJECT_KINDS
from handover_marl.datasets.generated.hands import Palms, make_hand_templates
from handover_marl.datasets.generated.human_grasps import draw_human_grasps, find_free_hands
from handover_marl.datasets.generated.objects import ProceduralObject, draw_object
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.robot_grasps import draw_robot_grasps
from handover_marl.datasets.generated.shapes import Part, Solid, make_surface


def draw_kind(kind: str, seed: int) -> ProceduralObject:
    return draw_object(RandomStream(seed), tuple(float(kind == other) for other in OBJECT_KINDS))


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_objects_are_centered_and_graspable(kind: str) -> None:
    for seed in range(8):
        item = draw_kind(kind, seed)
        corners = Solid(map(make_surface, item.parts)).corners
        low, high = corners.min(axis=0), corners.max(axis=0)
        assert item.kind == kind
        assert np.abs(low + high).max() < 2e-4
        assert (high - low).min() < 0.08
        assert 0.05 < (high - low).max() < 0.30
        assert len(item.up_axes) == 6
        assert sum(item.up_axes) > 0.0


@pytest.mark.parametrize("kind", OBJECT_KINDS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_human_hands_hold_objects(kind: str, side: Side) -> None:
    item = draw_kind(kind, 4)
    solid, size = Solid(map(make_surface, item.parts)), SUBJECT_SIZES[5]
    grasps = draw_human_grasps(RandomStream(1), solid, item.up_axes, size, side)
    assert grasps is not None
    assert grasps.side == side
    assert (np.diff(grasps.wrist_distance) >= 0.0).all()
    hand = scale_hand(size, side)
    for row in range(len(grasps)):
        assert grasps.touching[row, 4]
        assert grasps.touching[row, :4].sum() >= 2
        assert grasps.overlap[row] < 0.004
        # Grasps of both sides are in the object's frame, not mirrored: joints are outside, fingertips near.
        points = hand.compute_keypoints(grasps.compute_hand_dof(row))
        distances = solid.compute_distances(points)
        assert distances.min() > -0.004
        assert distances[8::4].min() < 0.02


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_robot_grasps_span_the_object(kind: str) -> None:
    solid = Solid(map(make_surface, draw_kind(kind, 2).parts))
    grasps = draw_robot_grasps(RandomStream(5), solid)
    assert 10 < len(grasps) <= 60
    rotations = grasps[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (len(grasps), 1, 1)), atol=1e-6)
    # The object is between the pads, which are outside of it.
    depths = np.linspace(0.08, 0.112, 9)
    middle = grasps[:, None, :3, 3] + depths[:, None] * grasps[:, None, :3, 2]
    assert (solid.compute_distances(middle).min(axis=1) < 0.0).all()
    for sign in (-0.041, 0.041):
        pads = middle + sign * grasps[:, None, :3, 0]
        assert (solid.compute_distances(pads) > 0.0).all()


def test_hands_without_a_free_posture() -> None:
    """Hands inside a body have no free posture, which is not an error, and hands far away from it all have one."""
    body = Solid([make_surface(Part("box", (1.0, 1.0, 1.0), "red"))])
    templates, rows = make_hand_templates(SUBJECT_SIZES[3]), np.arange(5)
    palms = Palms(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)))
    assert len(find_free_hands(body, templates, palms, rows)) == 0
    far = Palms(np.full((5, 3), 5.0), palms.rotation)
    assert find_free_hands(body, templates, far, rows).tolist() == [0, 1, 2, 3, 4]
