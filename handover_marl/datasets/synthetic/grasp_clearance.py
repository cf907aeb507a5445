"""Fraction of the best robot grasps of an object that are clear of the giver's hand.

Givers hold objects so that they can be taken. The measure considers the grasps that a waiting robot
would prefer, and counts those whose grasp and final approach are clear of the hand.
"""

from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from handover_marl.geometry.panda import (
    GRIPPER_FROM_HAND,
    MAX_RANKED_GRASPS,
    PREFERRED_HAND_POSE,
    RANKING_ROTATION_WEIGHT,
    RANKING_STANDOFF,
)
from handover_marl.geometry.poses import compose, compute_pose_distances, poses_from_matrices, transform_points

Array = npt.NDArray[np.float64]

#: Smallest distance (m) between points of the gripper and of the hand, which are each about 1 cm inside of the surface.
CLEARANCE = 0.02


@cache
def _make_gripper_points() -> Array:
    """Return points (n, 3) (m) of the gripper at a grasp and its approach, in the grasp's frame."""
    fingers = [(0.0, side * 0.045, z) for side in (-1, 1) for z in (0.065, 0.085, 0.105)]
    palm = [(0.0, side * y, z) for side in (-1, 1) for y in (0.03, 0.06, 0.09) for z in (0.02, 0.05)]
    points = np.array([*fingers, *palm, (0.0, 0.0, 0.06)])
    return np.concatenate([points - [0.0, 0.0, standoff] for standoff in (0.0, 0.03, 0.06, 0.10)])


def hand_poses_from_grasps(transforms: Array) -> Array:
    """Return poses (n, 7) of the Panda's hand link from grasp matrices (n, 4, 4)."""
    return np.asarray(compose(poses_from_matrices(transforms), np.array(GRIPPER_FROM_HAND)))


def place_gripper_points(grasps: Array) -> Array:
    """Return the gripper's points (n, p, 3) in m at grasps (n, 7) and their approaches, in the object's frame."""
    return np.asarray(transform_points(grasps[:, None], _make_gripper_points()))


def find_clear_grasps(gripper_points: Array, hand_points: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the grasps, with gripper points (n, p, 3), that are clear of hand keypoints (21, 3)."""
    wrist, digits = hand_points[:1], hand_points[1:].reshape(5, 4, 3)
    palm = 0.5 * (digits[:, 0] + wrist)
    hand = np.concatenate([hand_points, palm])
    points = gripper_points.reshape(-1, 3)
    nearest = cdist(hand, points, "sqeuclidean").min(axis=0).reshape(len(gripper_points), -1).min(axis=1)
    return np.asarray(nearest > CLEARANCE**2)


def compute_free_grasp_shares(world_from_object: Array, clear: npt.NDArray[np.bool_], grasps: Array) -> Array:
    """Return the shares (m,) of preferred robot grasps (n, 7) that are clear of the giver's hand, at poses (m, 7).

    Preferred grasps are those whose standoff poses are nearest to the pose of the waiting gripper. The mask `clear`
    (n,) is from `find_clear_grasps`.
    """
    standoffs = compose(compose(world_from_object[:, None], grasps), np.array(RANKING_STANDOFF))
    costs = compute_pose_distances(PREFERRED_HAND_POSE, standoffs.reshape(-1, 7), RANKING_ROTATION_WEIGHT)
    order = np.argsort(costs.reshape(len(standoffs), -1), axis=1, kind="stable")
    return np.asarray(clear[order[:, :MAX_RANKED_GRASPS]].mean(axis=1))
