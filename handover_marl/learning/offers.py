"""Offers of a giver: random handover poses, the features from which a network predicts success, and the best offer.

An offer is a vector of outputs of `HandoverPoseScheme`. Its features depend on what a person can see: the object, the
own hand, the gripper, and the known grasps of the object. They do not depend on the receiver's policy.
"""

import functools

import numpy as np
import numpy.typing as npt

from handover_marl.episode.metrics.fluency import CHEST, HALF_SHOULDER_WIDTH
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyArray, get_namespace, widen
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.geometry.rotations import (
    matrices_from_quaternions,
    multiply_quaternions,
    quaternions_from_rotation_vectors,
    rotate_points,
)
from handover_marl.learning.array_features import compute_handover_frames, rotate_to_frame, rotate_to_world
from handover_marl.learning.giver_schemes import HandoverPoseScheme
from handover_marl.learning.grasp_selector import MAX_CLEARANCE, LowestCostGraspSelector, compute_motion_costs
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.grasp_library import load_hand_poses

Array = npt.NDArray[np.float64]
Vectors = npt.NDArray[np.float32]

#: Name of the features in policy files, and the number of features of an offer.
OFFER_FEATURES, N_OFFER_FEATURES = "offer", 36
# Numbers of grasps of lowest cost over which the clearance to the person's hand is averaged.
_NUMBERS_OF_GRASPS = (1, 4, 16, 64)
# Extent of the gripper along the hand link's z axis, from behind its palm to the fingertips (m); desired distance of
# the joints of the person's hand from this line (m), and weight of the amount by which the distance is below it.
_BACK_Z, _TIP_Z, _DESIRED_CLEARANCE, _CLEARANCE_WEIGHT = -0.05, 0.11, 0.09, 4.0


def draw_offers(rng: np.random.Generator, count: int, spread: float) -> Vectors:
    """Draw `count` random offers (count, 7) in [-1, 1], float32; the first one is the recorded handover pose.

    Args:
        rng: Random generator.
        count: Number of offers.
        spread: Standard deviation of the outputs before they are clipped.
    """
    offers = np.clip(spread * rng.standard_normal((count, HandoverPoseScheme.size)), -1.0, 1.0)
    offers[0, :6] = 0.0
    return offers.astype(np.float32)


def compute_offered_poses(observation: Observation, offers: Vectors) -> Array:
    """Return the world poses (k, 7) of the object at k offers (k, 7) in the episode of an observation (1, ...)."""
    origins, frames = compute_handover_frames(observation)
    shifts = rotate_to_world(frames, widen(offers[:, :3]) * HandoverPoseScheme.max_output_translation)
    turns = rotate_to_world(frames, widen(offers[:, 3:6]) * HandoverPoseScheme.max_output_rotation)
    recorded = widen(observation["replay_object_poses"][:, -1, 3:])
    rotations = multiply_quaternions(quaternions_from_rotation_vectors(turns), recorded)
    return np.concatenate([origins + shifts, rotations], axis=1)


def compute_added_reaches(observation: Observation, offers: Vectors) -> Array:
    """Return how much farther the person reaches at k offers (k, 7) than in the recording, (k,) in m, at least 0.

    The reach is the distance of the wrist from the nearer shoulder of a person who faces the robot.

    Args:
        observation: Arrays (1, ...) of the giver's observation.
        offers: Offers (k, 7), outputs of `HandoverPoseScheme`.
    """
    recorded = widen(observation["replay_wrist_poses"][:, -1])
    wrist_in_object = compose(invert_pose(widen(observation["replay_object_poses"][:, -1])), recorded)
    wrists = np.concatenate([recorded, compose(compute_offered_poses(observation, offers), wrist_in_object)])[:, :3]
    shoulders = np.array(CHEST) + HALF_SHOULDER_WIDTH * np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    reaches = np.linalg.norm(wrists[:, None] - shoulders, axis=2).min(axis=1)
    added: Array = (reaches[1:] - reaches[0]).clip(0.0)
    return added


def compute_offer_features(observation: Observation, offers: Vectors, context: PolicyContext) -> Vectors | None:
    """Return the features (k, 36) of k offers in one episode; None if no grasp of the object is known.

    | features | meaning |
    |---|---|
    | 0-3 | clearance of the person's hand to the gripper, mean over the 1, 4, 16 and 64 nearest grasps (m, times 10) |
    | 4 | cost of the gripper's motion to the nearest grasp (m), see `LowestCostGraspSelector` |
    | 5-7 | grasp of lowest cost, if a small clearance has a cost, too: cost (m), clearance (m, times 10), motion (m) |
    | 8-16 | hand link at the nearest grasp: position in the world (m); y and z axes in the handover frame |
    | 17-25 | the same at the grasp of lowest cost |
    | 26-28 | position of the recorded handover in the world (m) |
    | 29-35 | the offer |

    Args:
        observation: Arrays (1, ...) of the giver's observation.
        offers: Offers (k, 7), outputs of `HandoverPoseScheme`.
        context: Known grasps of the objects.
    """
    grasps = _load_known_grasps(context, int(observation["object_classes"][0, 0]))
    if grasps is None:
        return None
    joints = inverse_transform_points(observation["object_poses"][:, :1], observation["hand_keypoints"])
    clearances = _compute_clearances(grasps, joints[0])
    origins, frames = compute_handover_frames(observation)
    objects = compute_offered_poses(observation, offers)
    weight = LowestCostGraspSelector.rotation_weight
    motions = compute_motion_costs(grasps[None], compose(invert_pose(objects), observation["gripper_pose"]), weight)
    costs = motions + _CLEARANCE_WEIGHT * (_DESIRED_CLEARANCE - clearances).clip(0.0)
    order, best, row = np.argsort(motions, axis=1, kind="stable"), np.argmin(costs, axis=1), np.arange(len(offers))
    means = [clearances[order[:, :number]].mean(axis=1) for number in _NUMBERS_OF_GRASPS]
    numbers = [*(10.0 * mean for mean in means), motions[row, order[:, 0]]]
    numbers += [costs[row, best], 10.0 * clearances[best], motions[row, best]]
    parts = [np.stack(numbers, axis=1)]
    for chosen in (order[:, 0], best):
        hands = compose(objects, grasps[chosen])
        columns = rotate_to_frame(frames, matrices_from_quaternions(hands[:, 3:]).swapaxes(1, 2))
        parts += [hands[:, :3], columns[:, 1], columns[:, 2]]
    parts += [np.broadcast_to(origins, (len(offers), 3)), offers]
    return np.concatenate(parts, axis=1).astype(np.float32)


def compute_offer_scores(outputs: AnyArray) -> AnyArray:
    """Return scores (k,) of offers, higher is better: probability of success times the share of the time that is saved.

    Args:
        outputs: Outputs (k, 2) of a network: logit of the success, and the time of the success as a share of the limit.
    """
    xp = get_namespace(outputs)
    return (1.0 - outputs[:, 1].clip(0.0, 1.0)) / (1.0 + xp.exp(-outputs[:, 0]))


def _compute_clearances(grasps: Array, joints: AnyArray) -> Array:
    """Return the distances (k,) in m of joints (16, 3) of a hand from the gripper's axis at k grasps (k, 7)."""
    axes = rotate_points(grasps[:, 3:], np.array([0.0, 0.0, 1.0]))
    x, y, z = (joints[None, :, axis] - grasps[:, None, axis] for axis in range(3))
    u, v, w = (axes[:, None, axis] for axis in range(3))
    along = (x * u + y * v + z * w).clip(_BACK_Z, _TIP_Z)
    x, y, z = x - along * u, y - along * v, z - along * w
    return np.sqrt(np.min(x * x + y * y + z * z, axis=-1)).clip(None, MAX_CLEARANCE)


@functools.lru_cache(maxsize=1024)
def _load_known_grasps(context: PolicyContext, object_class: int) -> Array | None:
    """Return poses (n, 7) of the hand link at a class's known grasps and their half turns, in its frame; cached."""
    poses = load_hand_poses(context.grasps, context.object_names[object_class])
    return None if poses is None else np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
