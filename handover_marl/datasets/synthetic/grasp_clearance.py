"""Fraction of the best robot grasps of an object that are clear of the giver's hand.

Givers hold objects so that they can be taken. The measure considers the grasps that a waiting robot
would prefer, and counts those whose grasp and final approach are clear of the hand.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.panda import (
    GRIPPER_FROM_HAND,
    MAX_RANKED_GRASPS,
    PREFERRED_HAND_POSE,
    RANKING_STANDOFF,
    compute_pose_distances,
)
from handover_marl.geometry.poses import compose, poses_from_matrices, transform_points

Array = npt.NDArray[np.float64]

#: Smallest distance (m) between points of the gripper and of the hand, which are each about 1 cm
#: inside of the surface.
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
    return compose(poses_from_matrices(transforms), np.array(GRIPPER_FROM_HAND))


def compute_free_grasp_share(world_from_object: Array, hand_points: Array, grasps: Array) -> float:
    """Return the fraction (0 to 1) of preferred robot grasps that are clear of the giver's hand.

    Preferred grasps are those whose standoff poses are nearest to the pose of the waiting gripper.

    Args:
        world_from_object: (7,) pose of the object, xyz (m) and quaternion xyzw.
        hand_points: (21, 3) keypoints of the hand in the world (m), in the order of
            `HandGeometry.compute_keypoints`.
        grasps: (n, 7) poses of the gripper's hand link in the object's frame.
    """
    wrist, digits = hand_points[:1], hand_points[1:].reshape(5, 4, 3)
    palm = 0.5 * (digits[:, 0] + wrist)
    hand = np.concatenate([hand_points, palm])
    world_from_hand = compose(world_from_object, grasps)
    standoffs = compose(world_from_hand, np.array(RANKING_STANDOFF))
    order = np.argsort(compute_pose_distances(PREFERRED_HAND_POSE, standoffs), kind="stable")
    points = _make_gripper_points()
    gripper = np.stack([transform_points(pose, points) for pose in world_from_hand[order[:MAX_RANKED_GRASPS]]])
    distances = np.linalg.norm(gripper[:, :, None] - hand, axis=-1).min(axis=(1, 2))
    return float((distances > CLEARANCE).mean())
