"""How much room a hand leaves for a gripper.

People offer things so that they can be taken. The measure: of the grasps that lie handiest for the waiting robot,
the share at which the gripper, on its last way to the grasp too, keeps clear of the hand.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from handover_marl.models.handiness import CANDIDATES, PREFERRED_POSE, STANDOFF, pose_distance
from handover_marl.models.panda import GRIPPER_FROM_HAND
from handover_marl.models.poses import compose, poses_from_matrices

Array = npt.NDArray[np.float64]

#: Distance (m) between points of the gripper and points of the hand, about a centimetre of flesh and one of steel.
CLEARANCE = 0.02


@cache
def _gripper_points() -> Array:
    """(n, 3) points (m) of the open gripper in the hand link's frame, at the grasp and 3, 6 and 10 cm before."""
    fingers = [(0.0, side * 0.045, z) for side in (-1, 1) for z in (0.065, 0.085, 0.105)]
    palm = [(0.0, side * y, z) for side in (-1, 1) for y in (0.03, 0.06, 0.09) for z in (0.02, 0.05)]
    points = np.array([*fingers, *palm, (0.0, 0.0, 0.06)])
    return np.concatenate([points - [0.0, 0.0, back] for back in (0.0, 0.03, 0.06, 0.10)])


def grasp_poses(transforms: Array) -> Array:
    """(n, 7) poses of the Panda's hand link in the object's frame from grasp matrices (n, 4, 4)."""
    return compose(poses_from_matrices(transforms), np.array(GRIPPER_FROM_HAND))


def room(world_from_object: Array, hand_points: Array, grasps: Array) -> float:
    """Share (0..1) of the handy grasps that keep clear of the hand.

    Args:
        world_from_object: (7,) pose of the object.
        hand_points: (k, 3) wrist, finger joints and tips in the world (m), in the order of `HandModel.keypoints`.
        grasps: (n, 7) poses of the gripper's hand link in the object's frame, from `grasp_poses`.
    """
    wrist, digits = hand_points[:1], hand_points[1:].reshape(5, 4, 3)
    palm = 0.5 * (digits[:, 0] + wrist)
    hand = np.concatenate([hand_points, palm])
    world_from_hand = compose(world_from_object, grasps)
    standoffs = compose(world_from_hand, np.array(STANDOFF))
    handy = world_from_hand[np.argsort(pose_distance(PREFERRED_POSE, standoffs), kind="stable")[:CANDIDATES]]
    gripper = np.stack([_points_in_world(pose) for pose in handy])
    gaps = np.linalg.norm(gripper[:, :, None] - hand, axis=-1).min(axis=(1, 2))
    return float((gaps > CLEARANCE).mean())


def _points_in_world(pose: Array) -> Array:
    points = _gripper_points()
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(points), 1))
    return compose(pose, np.concatenate([points, still], axis=1))[:, :3]
