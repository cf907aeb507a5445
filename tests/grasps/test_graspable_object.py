"""Tests of pad contacts and of offset grasps."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.grasps.graspable_object import collect_surface_points, compute_pad_margins
from handover_marl.grasps.validation import OFFSET_HAND_CLEARANCE, ValidatedGrasps, perturb_grasps
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances

TIP = 0.1126  # distance of the fingertips from the hand's frame (m)
HALVES = np.array([0.05, 0.02, 0.05])
BOX = trimesh.creation.box(extents=2.0 * HALVES)
POINTS = collect_surface_points(np.array(BOX.vertices), np.array(BOX.faces), 4000)
FAR = Spheres(np.array([[1.0, 0.0, 0.0]]), np.array([0.01]))


def pose_above(overlap: float, lateral: float = 0.0) -> np.ndarray:
    """Return the hand pose (7,) above the box.

    Args:
        overlap: Overlap of the fingers with the box (m).
        lateral: Distance from the middle of the box (m).
    """
    down = Rotation.from_euler("x", np.pi)
    return np.array([lateral, 0.0, HALVES[2] + TIP - overlap, *down.as_quat()])


@pytest.mark.parametrize(
    ("overlap", "lateral", "margin"),
    [
        (0.015, 0.0, 0.015),  # far from the edges of the pads
        (0.003, 0.0, 0.003),  # near the tips
        (0.030, 0.055, 0.011),  # near the edges, whose distance counts twice
        (-0.002, 0.0, 0.0),  # beyond the tips
    ],
)
def test_pad_margins(overlap: float, lateral: float, margin: float) -> None:
    assert compute_pad_margins(pose_above(overlap, lateral)[None], POINTS)[0] == pytest.approx(margin, abs=2.5e-3)


def test_offset_grasps_are_clear_of_hand_and_object() -> None:
    grasps = ValidatedGrasps(np.stack([pose_above(0.02), pose_above(0.02, 0.02)]), np.array([1.0, 0.0]))
    # A finger of the person on top blocks the first grasp.
    hand = Spheres(np.array([[0.0, 0.0, HALVES[2] + 0.012]]), np.array([0.01]))
    assert compute_grasp_clearances(grasps.poses[:1], hand, 0.08)[0] < 0.0
    kept = perturb_grasps(grasps, POINTS, hand, 0.08)
    assert len(kept.poses) > 0
    assert (compute_grasp_clearances(kept.poses, hand, 0.08) > OFFSET_HAND_CLEARANCE).all()
    assert (kept.success_rates == 1.0).all()
    unblocked = perturb_grasps(grasps, POINTS, FAR, 0.08)
    assert len(unblocked.poses) > len(kept.poses)
    # At this depth the hand's body collides with the box.
    deep = ValidatedGrasps(pose_above(0.08)[None], np.ones(1))
    assert len(perturb_grasps(deep, POINTS, FAR, 0.08).poses) == 0
