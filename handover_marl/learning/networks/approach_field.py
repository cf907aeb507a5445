"""Approach field: the next step of the robot's hand as a function of the hand's pose relative to a grasp.

The field gives the labels for imitation. Labels must depend only on what a network observes. The field satisfies this,
because it leads from any pose to the grasp, whatever motion led to that pose.

The hand first rotates and moves to a standoff, at a pace that matches the remaining decisions, because a hand that
arrives early would meet a person who is still lifting the object. The hand then moves in by a single step: GA-DDPG
closes the fingers as soon as more than 50 of 1,024 points are between them at the end of a decision, so that after
several small steps the fingertips would hold the object.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import PAD_DISTANCE
from handover_marl.geometry.poses import compose, invert_pose

Array = npt.NDArray[np.float64]

#: Largest translation (m) and Euler angle (rad) of one step, along or about each axis.
MAX_TRANSLATION, MAX_ROTATION = 0.06, np.pi / 6.0
# Smallest value to which the remaining decisions reduce the largest translation, and distance from the target below
# which they do not reduce it (m).
_MIN_TRANSLATION, _NEAR_DISTANCE = 0.02, 0.1
# Distance of the standoff from the grasp, back along the z axis of the hand at the grasp, and width of the range of
# distances, from half this width beyond the standoff on, over which the target changes from grasp to standoff (m).
STANDOFF, _STANDOFF_BAND = 0.055, 0.02
# The error of a hand pose is the distance of the middle between the pads from this axis, plus the weighted angle to the
# orientation at the grasp (m/rad). The hand moves in up to the first error, moves to the standoff from the second
# one on, and changes its target linearly between both (m).
_ROTATION_WEIGHT, _MIN_ERROR, _MAX_ERROR = 0.05, 0.008, 0.018
# Additional distance of the standoff per meter of error beyond `_MAX_ERROR`, and its largest distance (m).
_CONE_SLOPE, _MAX_STANDOFF = 0.5, 0.12


def compute_approach_steps(hands: Array, goals: Array, remaining: Array, spare_steps: int) -> Array:
    """Return the next motion of each of n robot hands towards a grasp of its own.

    Args:
        hands: (n, 7) present poses of the hand link, xyz (m) and quaternion xyzw.
        goals: (n, 7) poses of the hand link at the grasps, in the same frame, quaternions xyzw.
        remaining: (n,) numbers of remaining decisions, including this one.
        spare_steps: Number of decisions that should be left when a hand arrives; a larger one makes it faster.

    Returns:
        (n, 6) translations (m) and extrinsic xyz Euler angles (rad) in the frames of the present poses.
    """
    relative = compose(invert_pose(goals), hands)
    rotations = Rotation.from_quat(relative[:, 3:])
    standoffs = _compute_standoffs(relative, rotations)
    targets = goals.copy()
    targets[:, :3] -= standoffs[:, None] * Rotation.from_quat(goals[:, 3:]).as_matrix()[..., 2]
    motions = compose(invert_pose(hands), targets)
    length = np.linalg.norm(motions[:, :3], axis=1)
    pace = length / (np.maximum(remaining - spare_steps, 1.0))
    limited_pace = np.clip(pace, _MIN_TRANSLATION, MAX_TRANSLATION)
    max_translation = np.where(length < _NEAR_DISTANCE, MAX_TRANSLATION, limited_pace)
    return _limit_steps(motions[:, :3], Rotation.from_quat(motions[:, 3:]).as_rotvec(), max_translation)


def _compute_standoffs(relative: Array, rotations: Rotation) -> Array:
    """Return the distance before its grasp at which each of n hands should aim, (n,) in m; 0 to move to the grasp.

    Poses `relative` (n, 7; xyzw) are those of the hand link in the frames of the grasps, with these `rotations`.
    """
    pads = relative[:, :3] + PAD_DISTANCE * rotations.as_matrix()[..., 2]
    error = np.linalg.norm(pads[:, :2], axis=1) + _ROTATION_WEIGHT * rotations.magnitude()
    misalignment = (error - _MIN_ERROR) / (_MAX_ERROR - _MIN_ERROR)
    # Linear within half of the band either way, since labels that jump cannot be learned.
    distance = (-relative[:, 2] - STANDOFF - 0.5 * _STANDOFF_BAND) / _STANDOFF_BAND
    share = np.clip(np.maximum(misalignment, distance), 0.0, 1.0)
    cone = _CONE_SLOPE * np.maximum(0.0, error - _MAX_ERROR)
    standoffs: Array = share * np.minimum(STANDOFF + cone, _MAX_STANDOFF)
    return standoffs


def _limit_steps(translations: Array, rotation_vectors: Array, max_translation: Array) -> Array:
    """Scale n translations and rotation vectors, (n, 3) each, to at most `max_translation` (n,) and `MAX_ROTATION`.

    Returns steps (n, 6): translation (m) and extrinsic xyz Euler angles (rad).
    """
    by_translation = np.abs(translations).max(axis=1) / max_translation
    by_rotation = np.abs(rotation_vectors).max(axis=1) / MAX_ROTATION
    # Scaled together: a hand that rotates before it moves loses sight of the object.
    share = 1.0 / np.maximum(1.0, np.maximum(by_translation, by_rotation))
    euler = Rotation.from_rotvec(share[:, None] * rotation_vectors).as_euler("xyz")
    clipped = np.clip(euler, -MAX_ROTATION, MAX_ROTATION)
    return np.concatenate([share[:, None] * translations, clipped], axis=1)
