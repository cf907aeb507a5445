"""Tests of pad contacts and of offset grasps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.planning.clearance import Spheres, compute_grasp_clearances
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive import grasp_contact
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.grasp_contact import compute_pad_margins, sample_surface_points
from handover_marl.receivers.reactive.grasps import (
    GraspOffsets,
    GraspPreparationConfig,
    ValidatedGrasps,
    perturb_grasps,
)

TIP = 0.1126  # distance of the fingertips from the hand's frame (m)
HALVES = np.array([0.05, 0.02, 0.05])
BOX = trimesh.creation.box(extents=2.0 * HALVES)
POINTS = sample_surface_points(np.array(BOX.vertices), np.array(BOX.faces), 4000)
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


def test_worse_pad_counts() -> None:
    step = POINTS[(POINTS[:, 1] < 0.0) | (POINTS[:, 2] < HALVES[2] - 0.008)]
    for points in (step, step * np.array([1.0, -1.0, 1.0])):
        assert compute_pad_margins(pose_above(0.012)[None], points)[0] == pytest.approx(0.004, abs=2e-3)


def test_surface_points_are_uniform_and_repeatable() -> None:
    np.testing.assert_array_equal(POINTS, sample_surface_points(np.array(BOX.vertices), np.array(BOX.faces), 4000))
    assert (np.abs(POINTS) <= HALVES + 1e-9).all()
    random = POINTS[len(BOX.vertices) :]
    top = np.isclose(random[:, 2], HALVES[2]).mean()
    areas = HALVES[[0, 1, 2]] * HALVES[[1, 2, 0]]
    assert top == pytest.approx(areas[0] / (2.0 * areas.sum()), abs=0.03)


def test_offset_grasps_are_clear_of_hand_and_object() -> None:
    config = GraspOffsets()
    grasps = ValidatedGrasps(np.stack([pose_above(0.02), pose_above(0.02, 0.02)]), np.array([1.0, 0.0]))
    # A finger of the person on top blocks the first grasp.
    hand = Spheres(np.array([[0.0, 0.0, HALVES[2] + 0.012]]), np.array([0.01]))
    assert compute_grasp_clearances(grasps.poses[:1], hand, 0.08)[0] < 0.0
    kept = perturb_grasps(grasps, POINTS, hand, 0.08, config)
    assert len(kept.poses) > 0
    assert (compute_grasp_clearances(kept.poses, hand, 0.08) > config.min_clearance).all()
    assert (kept.success_rates == 1.0).all()
    unblocked = perturb_grasps(grasps, POINTS, FAR, 0.08, config)
    assert len(unblocked.poses) > len(kept.poses)
    # At this depth the hand's body collides with the box.
    deep = ValidatedGrasps(pose_above(0.06)[None], np.ones(1))
    assert len(perturb_grasps(deep, POINTS, FAR, 0.08, replace(config, backward=(0.0,))).poses) == 0


def test_unstable_grasps_get_no_offsets() -> None:
    grasps = ValidatedGrasps(pose_above(0.02)[None], np.zeros(1))
    assert perturb_grasps(grasps, POINTS, FAR, 0.08, GraspOffsets()).poses.shape == (0, 7)


def test_number_of_offset_grasps_is_limited() -> None:
    grasps = ValidatedGrasps(np.stack([pose_above(0.02, 0.001 * number) for number in range(10)]), np.ones(10))
    assert len(perturb_grasps(grasps, POINTS, FAR, 0.08, GraspOffsets(max_grasps=20)).poses) <= 20


@pytest.mark.parametrize(("quick", "stored"), [(True, False), (True, True), (False, False)])
def test_many_objects_are_validated_quickly(monkeypatch: pytest.MonkeyPatch, quick: bool, stored: bool) -> None:
    """Grasps are validated quickly only in data sets with many objects, for objects without a stored record."""
    used: list[GraspPreparationConfig] = []

    def validate(urdf: Path, panda: Path, known: np.ndarray, config: GraspPreparationConfig) -> ValidatedGrasps:
        used.append(config)
        return ValidatedGrasps(known, np.ones(len(known)))

    monkeypatch.setattr(grasp_contact, "validate_grasps", validate)
    monkeypatch.setattr(grasp_contact, "has_validation_record", lambda *_: stored)
    config = ReactiveConfig()
    context = replace(make_policy_context(SyntheticDataset()), quick_validation=quick)
    grasp_contact.load_graspable_object.cache_clear()
    grasp_contact.load_graspable_object(context, "025_mug", config)
    grasp_contact.load_graspable_object.cache_clear()
    assert used == [config.quick_preparation if quick and not stored else config.preparation]
