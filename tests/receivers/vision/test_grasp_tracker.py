import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, invert_pose, transform_points
from handover_marl.receivers.vision import grasp_tracker
from handover_marl.receivers.vision.grasp_predictor import GraspPrediction
from handover_marl.receivers.vision.grasp_tracker import COST_SCALE, FilterGains, GraspTracker

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


class FixedPredictor:
    """Grasp predictor that returns fixed world grasps in the hand link's frame."""

    def __init__(self, grasps: Array = GRASPS, quality: tuple[float, ...] = (0.9, 0.5, 0.01)) -> None:
        self.grasps, self.quality, self.center = grasps, np.array(quality), CENTER
        self.n_calls = 0

    def __call__(self, item: Array, hand: Array, velocity: Array, rng: np.random.Generator) -> GraspPrediction:
        self.n_calls += 1
        center = transform_points(invert_pose(LINK), self.center)
        return GraspPrediction(compose(invert_pose(LINK), self.grasps), self.quality, center)


def in_world(tracker: GraspTracker) -> Array:
    moved = tracker.grasps.copy()
    moved[:, :3] += tracker.object_pose[:3]
    return moved


def is_same_grasp(one: Array, other: Array) -> bool:
    return bool(np.allclose(one[:3], other[:3], atol=1e-9) and abs(one[3:] @ other[3:]) > 1.0 - 1e-9)


def test_candidates_are_good_grasps_and_half_turns() -> None:
    tracker = GraspTracker(FixedPredictor(), 0)
    assert not tracker.is_initialized
    tracker.update(0.0, LINK, ITEM, HAND)
    assert tracker.is_initialized
    assert len(tracker.grasps) == 4
    found = in_world(tracker)
    half = compose(GRASPS, np.array(HALF_TURN))
    for pose, wanted in zip(found, [GRASPS[0], GRASPS[1], half[0], half[1]], strict=True):
        assert is_same_grasp(pose, wanted)
    np.testing.assert_allclose(tracker.costs, -COST_SCALE * np.log([0.9, 0.5, 0.9, 0.5]))


def test_selected_grasp_is_first_and_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grasp_tracker, "_NEAR_DISTANCE", 0.1)
    monkeypatch.setattr(grasp_tracker, "_FAR_GAINS", FilterGains(0.5, 0.1, 0.5))
    predictor = FixedPredictor()
    tracker = GraspTracker(predictor, 0)
    tracker.update(0.0, LINK, ITEM, HAND)
    chosen = tracker.grasps[0]
    tracker.selected = chosen
    predictor.grasps = GRASPS + np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracker.update(0.05, LINK, ITEM, HAND)
    np.testing.assert_allclose(tracker.grasps[0][:3], chosen[:3] + np.array([0.005, 0.0, 0.0]), atol=1e-3)
    assert len(tracker.grasps) == 5


def make_near_tracker(monkeypatch: pytest.MonkeyPatch, predictor: FixedPredictor) -> GraspTracker:
    """Return a tracker with two views from nearby, which has a keyframe."""
    monkeypatch.setattr(grasp_tracker, "_NEAR_DISTANCE", 0.5)
    tracker = GraspTracker(predictor, 0)
    for number in range(2):
        tracker.update(0.05 * number, LINK, ITEM, HAND)
    return tracker


def test_registration_tracks_the_surface_nearby(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = make_near_tracker(monkeypatch, FixedPredictor())
    for number in range(2, 8):
        tracker.update(0.05 * number, LINK, ITEM + np.array([0.005, 0.0, 0.003]) * (number - 1), HAND)
    moved = transform_points(LINK, np.array([0.03, 0.0, 0.018])) - LINK[:3]
    np.testing.assert_allclose(tracker.object_pose[:3], CENTER + moved, atol=3e-3)


def test_strayed_track_is_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = FixedPredictor()
    tracker = make_near_tracker(monkeypatch, predictor)
    tracker.selected = tracker.grasps[0]
    assert tracker.selected is not None
    predictor.center = CENTER + 0.08
    tracker.update(0.1, LINK, ITEM, HAND)
    assert tracker.selected is None
    np.testing.assert_allclose(tracker.object_pose[:3], predictor.center, atol=1e-9)
