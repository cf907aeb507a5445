"""Interpolation of keyframes at 25 Hz to joint trajectories at 1 kHz, as in HandoverSim.

Positions are interpolated by cubic splines, rotations by slerp. Angles are intrinsic XYZ Euler
angles (rad), unwrapped for the object and the hand's base.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from handover_marl.config import HAND_DOF
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.synthetic.clutter import ClutterObject
from handover_marl.datasets.synthetic.handover_motion import KEYFRAME_PERIOD, KeyframeMotion
from handover_marl.geometry.poses import multiply_quaternions

#: Frames of 1 ms between two keyframes.
STRIDE = 40

# Spacing (rad or m) of a grid that values are rounded to. It hides the last bits of sines and
# splines, which differ between machines and versions of NumPy. A power of two, since decimal
# constants in the inputs would give ties.
_GRID = 2.0**-23


def compute_trajectories(
    motion: KeyframeMotion, clutter: Sequence[ClutterObject]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], int]:
    """Return the trajectories of all objects and of the hand at 1 kHz in the world frame.

    Args:
        motion: Keyframes of the handed-over object and the hand in the table's frame.
        clutter: Other objects in the table's frame.

    Returns:
        Positions and Euler angles (T, n, 6) of the objects, the handed-over one first, joint
        positions (T, 51) of the hand, and the first frame in which the hand is visible.
    """
    target = compute_object_trajectory(motion)
    object_dof = np.repeat(target[:, None], 1 + len(clutter), axis=1)
    for column, clutter_object in enumerate(clutter, start=1):
        angles = Rotation.from_matrix(clutter_object.rotation).as_euler("XYZ")
        object_dof[:, column] = round_to_grid([*clutter_object.position, *angles])
    hand_dof = compute_hand_trajectory(motion)
    hand_first = motion.hand_first * STRIDE
    object_dof[:, :, 2] += TABLE_HEIGHT
    hand_dof[hand_first:, 2] += TABLE_HEIGHT
    return object_dof, hand_dof, hand_first


def compute_object_trajectory(motion: KeyframeMotion) -> npt.NDArray[np.float32]:
    """Return the handed-over object's positions and Euler angles (T, 6) at 1 kHz."""
    position = _interpolate_positions(motion.object_position)
    angles = np.unwrap(_interpolate_angles(motion.object_rotation), axis=0)
    return round_to_grid(np.concatenate([position, angles], axis=1))


def compute_hand_trajectory(motion: KeyframeMotion) -> npt.NDArray[np.float32]:
    """Return the hand's joint positions (T, 51) at 1 kHz.

    They are the base position (m), the base angles and 45 finger angles (rad). Frames
    without a hand are zero.
    """
    first = motion.hand_first
    position = _interpolate_positions(motion.base_position[first:])
    angles = np.unwrap(_interpolate_angles(motion.base_rotation[first:]), axis=0)
    trajectory = np.zeros((first * STRIDE + len(position), HAND_DOF), dtype=np.float32)
    visible = trajectory[first * STRIDE :]
    visible[:, :3], visible[:, 3:6] = round_to_grid(position), round_to_grid(angles)
    _interpolate_fingers(motion.fingers[first:], visible[:, 6:])
    return trajectory


def round_to_grid(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return values rounded to multiples of `_GRID`, without negative zeros."""
    return (np.round(np.asarray(values, dtype=np.float64) / _GRID) * _GRID + 0.0).astype(np.float32)


def _sample_times(n_keyframes: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    keyframe_times = np.arange(n_keyframes, dtype=np.float64) * KEYFRAME_PERIOD
    frames = np.arange((n_keyframes - 1) * STRIDE + 1, dtype=np.float64)
    return keyframe_times, frames * (KEYFRAME_PERIOD / STRIDE)


def _interpolate_positions(keyframes: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    keyframe_times, times = _sample_times(len(keyframes))
    return np.asarray(CubicSpline(keyframe_times, keyframes)(times))


def _interpolate_fingers(keyframes: npt.NDArray[np.float64], angles: npt.NDArray[np.float32]) -> None:
    """Write finger joint angles at 1 kHz to `angles` (T, 45); only intervals in which joints move are interpolated."""
    n, n_joints = len(keyframes), keyframes.shape[1] // 3
    moves = (keyframes[1:] != keyframes[:-1]).any(axis=1)
    # Number of each keyframe among those that differ from the one before.
    posture = np.concatenate([[0], np.cumsum(moves)])
    postures = keyframes[np.concatenate([[True], moves])]
    rotations = Rotation.from_euler("XYZ", postures.reshape(-1, 3))
    still = round_to_grid(rotations.as_euler("XYZ")).reshape(len(postures), -1)
    angles[:-1].reshape(n - 1, STRIDE, -1)[:] = still[posture[:-1], None]
    angles[-1] = still[-1]
    moving = np.flatnonzero(moves)
    if len(moving):
        starts = (posture[moving, None] * n_joints + np.arange(n_joints)).ravel()
        between = _interpolate_intervals(rotations, starts, starts + n_joints, np.repeat(moving, n_joints))
        frames = between.reshape(len(moving), n_joints, STRIDE, 3).swapaxes(1, 2)
        angles[:-1].reshape(n - 1, STRIDE, -1)[moving] = round_to_grid(frames).reshape(len(moving), STRIDE, -1)


def _interpolate_angles(keyframes: Rotation) -> npt.NDArray[np.float64]:
    starts = np.arange(len(keyframes) - 1)
    between = _interpolate_intervals(keyframes, starts, starts + 1, starts)
    return np.concatenate([between.reshape(-1, 3), keyframes[-1:].as_euler("XYZ")])


def _interpolate_intervals(
    rotations: Rotation, starts: npt.NDArray[np.int64], ends: npt.NDArray[np.int64], intervals: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Return the Euler angles (k, STRIDE, 3) between k pairs of rotations, from each first one on.

    As SciPy's Slerp, but several times as fast: rotations of constant axis.

    Args:
        rotations: Rotations at keyframes.
        starts: (k,) indices of the first rotations.
        ends: (k,) indices of the second rotations.
        intervals: (k,) numbers of the keyframes at which the intervals begin.
    """
    quaternions = rotations.as_quat()
    conjugates = quaternions[starts] * [-1.0, -1.0, -1.0, 1.0]
    vectors = Rotation.from_quat(multiply_quaternions(conjugates, quaternions[ends])).as_rotvec()
    begins = (intervals * KEYFRAME_PERIOD)[:, None]
    times = (intervals[:, None] * STRIDE + np.arange(STRIDE)) * (KEYFRAME_PERIOD / STRIDE)
    shares = (times - begins) / (((intervals + 1) * KEYFRAME_PERIOD)[:, None] - begins)
    turns = Rotation.from_rotvec((vectors[:, None] * shares[..., None]).reshape(-1, 3)).as_quat()
    between = multiply_quaternions(quaternions[starts][:, None], turns.reshape(-1, STRIDE, 4))
    return np.asarray(Rotation.from_quat(between.reshape(-1, 4)).as_euler("XYZ")).reshape(-1, STRIDE, 3)
