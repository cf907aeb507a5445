"""Tests of the features from which a giver predicts the success of an offer."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.metrics.fluency import CHEST, HALF_SHOULDER_WIDTH
from handover_marl.episode.observations import Observation, add_episode_axis
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose, transform_points
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.grasps.selector import MAX_CLEARANCE, load_validated_grasps
from handover_marl.learning.adaptive_giver import (
    N_OFFER_FEATURES,
    OfferFeatures,
    Vectors,
    compute_added_reaches,
    compute_offer_scores,
    compute_offered_poses,
    draw_offers,
)
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances
from handover_marl.receivers import make_policy_context
from tests.givers.test_givers import seen
from tests.learning.test_schemes import handover_action

CONTEXT = make_policy_context(SyntheticDataset())
FEATURES = OfferFeatures(CONTEXT)
seeds = st.integers(0, 1000)


def draw_observation(seed: int) -> Observation:
    """Return an observation with the fingers 2 to 15 cm from the object, which already is at its handover pose."""
    rng = np.random.default_rng(seed)
    item = seen()["object_poses"][0].copy()
    item[3:] = rng.normal(size=4)
    item[3:] /= np.linalg.norm(item[3:])
    directions = rng.normal(size=(16, 3))
    joints = item[:3] + rng.uniform(0.02, 0.15, (16, 1)) * directions / np.linalg.norm(directions, axis=1)[:, None]
    poses = np.tile(item, (5, 1))
    return seen(object_poses=poses, replay_object_poses=poses, hand_keypoints=joints.astype(np.float32))


def compute_features(observation: Observation, offers: Vectors) -> Vectors:
    features = FEATURES(add_episode_axis(observation), offers)
    assert features is not None
    return features


@given(seeds)
def test_offered_poses_are_those_to_which_the_action_scheme_moves_the_object(seed: int) -> None:
    observation, offer = draw_observation(seed), draw_offers(np.random.default_rng(seed), 2, 0.5)[1:]
    action = handover_action(offer[0], **observation).astype(np.float64)
    wrist = observation["replay_wrist_poses"][-1].astype(np.float64)
    turn = np.concatenate([wrist[:3] + action[1:4], quaternion(action[4:7])])
    around = np.concatenate([wrist[:3], [0, 0, 0, 1]])
    moved = compose(turn, compose(invert_pose(around), observation["replay_object_poses"][-1].astype(np.float64)))
    (found,) = compute_offered_poses(add_episode_axis(observation), offer)
    np.testing.assert_allclose(found[:3], moved[:3], atol=1e-5)
    assert abs(found[3:] @ moved[3:]) == pytest.approx(1.0, abs=1e-6)


def test_reaches_grow_by_the_distance_from_the_nearer_shoulder() -> None:
    """The recorded wrist is in front of the right shoulder; the robot is at smaller y."""
    pose = np.float32([CHEST[0] - HALF_SHOULDER_WIDTH, CHEST[1] - 0.4, CHEST[2], 0, 0, 0, 1])
    gripper = pose - np.float32([0, 0.5, 0, 0, 0, 0, 0])
    poses = {key: np.tile(pose, (5, 1)) for key in ("object_poses", "replay_object_poses", "replay_wrist_poses")}
    observation = add_episode_axis(seen(gripper_pose=gripper, **poses))
    offers = np.zeros((3, 7), np.float32)
    offers[:, 0] = 0.0, 0.8, -0.8  # towards the gripper by 0.2 m, and back
    np.testing.assert_allclose(compute_added_reaches(observation, offers), [0.0, 0.2, 0.0], atol=1e-6)


def quaternion(vector: np.ndarray) -> np.ndarray:
    half = np.linalg.norm(vector) / 2.0
    return np.append(np.sinc(half / np.pi) / 2.0 * vector, np.cos(half))


@pytest.mark.slow
@given(seeds)
def test_the_best_grasp_is_that_of_an_observation_of_the_offered_object(seed: int) -> None:
    """The hand moves with the object, so clearances are those of the present observation."""
    observation, offer = draw_observation(seed), draw_offers(np.random.default_rng(seed), 2, 0.5)[1:]
    features = compute_features(observation, offer)
    (pose,) = compute_offered_poses(add_episode_axis(observation), offer)
    joints = transform_points(
        pose, inverse_transform_points(observation["object_poses"][0], observation["hand_keypoints"])
    )
    known = load_hand_poses(CONTEXT.load_grasps, CONTEXT.object_names[int(observation["object_classes"][0])])
    assert known is not None
    grasps = compose(pose, np.concatenate([known, compose(known, np.array(HALF_TURN))]))
    gripper = observation["gripper_pose"].astype(float)
    turns = Rotation.from_quat(gripper[3:]).inv() * Rotation.from_quat(grasps[:, 3:])
    fingers = Spheres(joints, np.full(16, 0.012))
    clearances = compute_grasp_clearances(grasps, fingers, 0.08, flange=False).clip(None, MAX_CLEARANCE)
    motions = np.linalg.norm(grasps[:, :3] - gripper[:3], axis=1) + 0.25 * turns.magnitude()
    costs = motions + 10.0 * np.maximum(0.03 - clearances, 0.0) + 5.0 * (clearances < 0.003)
    nearest, best = np.argsort(motions), int(np.argmin(costs))
    for place, number in enumerate((1, 4, 16, 64)):
        some = clearances[nearest[:number]]
        assert features[0, place] / 10.0 == pytest.approx(some.mean(), abs=1e-5)
        assert features[0, 4 + place] == pytest.approx((some >= 0.003).mean(), abs=1e-5)
    assert features[0, 8] == pytest.approx(motions.min(), abs=1e-5)
    expected = [costs[best], 10.0 * clearances[best], motions[best], 0.0]
    np.testing.assert_allclose(features[0, 9:13], expected, atol=1e-4)


def test_offers_within_the_arms_reach_have_small_distances() -> None:
    """An object 0.1 m from the gripper is within reach, one a meter away is not; larger distances count as 0.3 m."""
    observation, offers = draw_observation(0), np.zeros((2, 7), np.float32)
    arm = ArmInWorld.for_panda(CONTEXT.panda_urdf, CONTEXT.panda, 0.03)
    hand = arm.compute_hand_pose(observation["robot_joint_position"][:7].astype(float))
    near, far = (hand.astype(np.float32) + np.float32([0, y, 0, 0, 0, 0, 0]) for y in (0.1, 1.0))
    found = []
    for pose in (near, far):
        poses = np.tile(pose, (5, 1))
        moved = observation | {"object_poses": poses, "replay_object_poses": poses}
        found.append(compute_features(moved, offers)[0, 13:19])
    assert found[0][-1] == found[0][:5].min() < 0.1
    assert found[1][-1] == pytest.approx(3.0)


def test_grasps_that_may_not_hold_cost_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Features 19 to 37 are those of the validated grasps, which have costs of the hold."""
    item = int(draw_observation(0)["object_classes"][0])
    validated = load_validated_grasps(CONTEXT, item)
    assert validated is not None
    observation, offers = draw_observation(0), draw_offers(np.random.default_rng(0), 3, 0.5)
    costs = np.zeros(len(validated[0]))
    monkeypatch.setattr("handover_marl.learning.adaptive_giver.load_validated_grasps", lambda *_: (validated[0], costs))
    firm = compute_features(observation, offers)
    costs[:] = 2.0
    loose = compute_features(observation, offers)
    np.testing.assert_array_equal(firm[:, :19], loose[:, :19])
    np.testing.assert_allclose(loose[:, 28] - firm[:, 28], 0.2, atol=1e-5)
    np.testing.assert_allclose(loose[:, 31], 2.0)


def test_features_have_the_documented_number_and_end_with_the_offer() -> None:
    offers = draw_offers(np.random.default_rng(0), 5, 0.5)
    features = compute_features(draw_observation(0), offers)
    assert features.shape == (5, N_OFFER_FEATURES)
    assert features.dtype == np.float32
    np.testing.assert_array_equal(features[:, 41:], offers)
    assert not offers[0, :6].any()
    assert np.abs(offers[1:, :6]).all()


def test_objects_may_have_few_known_grasps_or_none() -> None:
    observation, offers = add_episode_axis(draw_observation(0)), draw_offers(np.random.default_rng(0), 2, 0.5)
    assert OfferFeatures(replace(CONTEXT, load_grasps=lambda name: None))(observation, offers) is None
    one = OfferFeatures(replace(CONTEXT, load_grasps=lambda name: CONTEXT.load_grasps(name)[:1]))(observation, offers)
    assert np.shape(one) == (2, N_OFFER_FEATURES)


def test_the_score_is_the_probability_of_success_times_the_saved_time() -> None:
    outputs = np.array([[0.0, 0.5], [np.log(3.0), 0.2], [100.0, 2.0], [100.0, -1.0]])
    np.testing.assert_allclose(compute_offer_scores(outputs), [0.25, 0.6, 0.0, 1.0])
