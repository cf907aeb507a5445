"""Tests of the tracking of object and grasps in point clouds."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, invert_pose, transform_points
from handover_marl.receivers.vision import grasp_tracker
from handover_marl.receivers.vision.grasp_predictor import GraspPrediction
from handover_marl.receivers.vision.grasp_tracker import COST_SCALE, FilterGains, GraspTracker, Keyframe, LabelVotes

Array = NDArray[np.float64]

LINK = np.array([0.4, 0.1, 1.2, *Rotation.from_euler("xyz", [2.0, 0.3, -0.4]).as_quat()])
CENTER = np.array([0.6, 0.2, 1.1])
GRASPS = np.array(
    [
        [0.6, 0.2, 1.2, *Rotation.from_euler("x", np.pi).as_quat()],
        [0.5, 0.2, 1.1, *Rotation.from_euler("y", np.pi / 2).as_quat()],
        [0.6, 0.3, 1.1, *Rotation.from_euler("x", np.pi / 2).as_quat()],
    ]
)
RNG = np.random.default_rng(0)
ITEM = 0.02 * RNG.normal(size=(100, 3)) + [0.0, 0.0, 0.3]
HAND = 0.02 * RNG.normal(size=(30, 3)) + [0.0, 0.05, 0.3]


def test_most_views_decide_what_a_voxel_shows_and_old_ones_are_forgotten() -> None:
    """One of four views takes the object for the hand; later, the hand is where the object was."""
    votes = LabelVotes(voxel_size=0.02, memory=0.5)
    points = np.array([[0.001, 0.001, 0.001], [0.002, 0.002, 0.002], [0.3, 0.0, 0.0]])
    for number, is_hand in enumerate([False, False, True, False]):
        assert votes.update(0.05 * number, points, np.array([is_hand, is_hand, True])).tolist() == [False, False, True]
    assert all(votes.update(3.0 + 0.05 * number, points, np.ones(3, dtype=np.bool_)).all() for number in range(5))


class FixedPredictor:
    """Grasp predictor that returns fixed world grasps in the hand link's frame."""

    def __init__(self) -> None:
        self.grasps, self.center = GRASPS, CENTER

    def __call__(self, item: Array, hand: Array, velocity: Array, rng: np.random.Generator) -> GraspPrediction:
        world = invert_pose(LINK)
        quality = np.array([0.9, 0.5, 0.01])
        return GraspPrediction(compose(world, self.grasps), quality, transform_points(world, self.center))


def test_candidates_are_good_grasps_and_half_turns() -> None:
    tracker = GraspTracker(FixedPredictor(), 0)
    assert not tracker.position.is_known
    tracker.update(0.0, LINK, ITEM, HAND)
    assert tracker.position.is_known
    wanted = np.concatenate([GRASPS[:2], compose(GRASPS[:2], np.array(HALF_TURN))])
    np.testing.assert_allclose(tracker.grasps[:, :3] + tracker.object_pose[:3], wanted[:, :3], atol=1e-9)
    np.testing.assert_allclose(np.abs((tracker.grasps[:, 3:] * wanted[:, 3:]).sum(axis=1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(tracker.costs, -COST_SCALE * np.log([0.9, 0.5, 0.9, 0.5]))


def test_selected_grasp_is_first_and_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grasp_tracker, "_NEAR_DISTANCE", 0.1)
    monkeypatch.setattr(grasp_tracker, "_FAR_GAINS", FilterGains(0.5, 0.1, 0.5))
    predictor = FixedPredictor()
    tracker = GraspTracker(predictor, 0)
    tracker.update(0.0, LINK, ITEM, HAND)
    chosen = tracker.selected = tracker.grasps[0]
    predictor.grasps = GRASPS + np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracker.update(0.05, LINK, ITEM, HAND)
    np.testing.assert_allclose(tracker.grasps[0][:3], chosen[:3] + np.array([0.005, 0.0, 0.0]), atol=1e-3)
    assert len(tracker.grasps) == 5


def test_the_surface_is_registered_nearby_until_the_track_strays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grasp_tracker, "_NEAR_DISTANCE", 0.5)
    predictor = FixedPredictor()
    tracker = GraspTracker(predictor, 0)
    for number in range(8):
        tracker.update(0.05 * number, LINK, ITEM + np.array([0.005, 0.0, 0.003]) * max(0, number - 1), HAND)
    moved = transform_points(LINK, np.array([0.03, 0.0, 0.018])) - LINK[:3]
    np.testing.assert_allclose(tracker.object_pose[:3], CENTER + moved, atol=3e-3)
    tracker.selected, predictor.center = tracker.grasps[0], CENTER + moved + 0.08
    tracker.update(0.4, LINK, ITEM, HAND)
    assert tracker.selected is None
    np.testing.assert_allclose(tracker.object_pose[:3], predictor.center, atol=1e-9)


def test_registration_of_a_sphere() -> None:
    ball = RNG.normal(size=(3000, 3))
    ball *= 0.05 / np.linalg.norm(ball, axis=1, keepdims=True)
    translation = np.array([0.008, -0.006, 0.004])
    found, share = Keyframe(ball).register(ball[::7] + translation)
    assert share == 1.0
    np.testing.assert_allclose(found, translation, atol=0.003)
