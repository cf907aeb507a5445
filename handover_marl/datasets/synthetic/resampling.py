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

Array = npt.NDArray[np.float64]

#: Frames of 1 ms between two keyframes.
STRIDE = 40

# Spacing (rad or m) of a grid that values are rounded to. It hides the last bits of sines and
# splines, which differ between machines and versions of NumPy. A power of two, since decimal
# constants in the inputs would give ties.
_GRID = 2.0**-23
# Number of intervals that are computed together; larger arrays do not reuse memory.
_N_INTERVALS = 80
_UNSURE_STEP = 1e-5  # of the grid
_SMALLEST_TURN = 1e-300  # rad; avoids a division by zero


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
    if clutter:
        angles = Rotation.from_matrix(np.stack([item.rotation for item in clutter])).as_euler("XYZ")
        object_dof[:, 1:] = round_to_grid(np.concatenate([[item.position for item in clutter], angles], axis=1))
    hand_dof = compute_hand_trajectory(motion)
    hand_first = motion.hand_first * STRIDE
    object_dof[:, :, 2] += TABLE_HEIGHT
    hand_dof[hand_first:, 2] += TABLE_HEIGHT
    return object_dof, hand_dof, hand_first


def compute_object_trajectory(motion: KeyframeMotion) -> npt.NDArray[np.float32]:
    """Return the handed-over object's positions and Euler angles (T, 6) at 1 kHz."""
    position = _interpolate_positions(motion.object_position)
    angles = _interpolate_angles(motion.object_rotation)
    return round_to_grid(np.concatenate([position, angles], axis=1))


def compute_hand_trajectory(motion: KeyframeMotion) -> npt.NDArray[np.float32]:
    """Return the hand's joint positions (T, 51) at 1 kHz.

    They are the base position (m), the base angles and 45 finger angles (rad). Frames
    without a hand are zero.
    """
    first = motion.hand_first
    position = _interpolate_positions(motion.base_position[first:])
    angles = _interpolate_angles(motion.base_rotation[first:])
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


def _interpolate_fingers(keyframes: Array, angles: npt.NDArray[np.float32]) -> None:
    """Write finger joint angles at 1 kHz to `angles` (T, 45)."""
    n, n_joints = len(keyframes), keyframes.shape[1] // 3
    moves = (keyframes[1:] != keyframes[:-1]).any(axis=1)
    # Number of each keyframe among those that differ from the one before.
    posture = np.concatenate([[0], np.cumsum(moves)])
    postures = keyframes[np.concatenate([[True], moves])]
    rotations = Rotation.from_euler("XYZ", postures.reshape(-1, 3))
    quaternions, still = rotations.as_quat(), round_to_grid(rotations.as_euler("XYZ")).reshape(len(postures), -1)
    angles[:-1].reshape(n - 1, STRIDE, -1)[:] = still[posture[:-1], None]
    angles[-1] = still[-1]
    moving = np.flatnonzero(moves)
    if len(moving):
        starts = (posture[moving, None] * n_joints + np.arange(n_joints)).ravel()
        between = _interpolate_intervals(quaternions, starts, starts + n_joints, np.repeat(moving, n_joints))
        frames = between.reshape(len(moving), n_joints, STRIDE, 3).swapaxes(1, 2)
        angles[:-1].reshape(n - 1, STRIDE, -1)[moving] = round_to_grid(frames).reshape(len(moving), STRIDE, -1)


def _interpolate_angles(keyframes: Rotation) -> Array:
    """Return Euler angles (T, 3) at 1 kHz without jumps."""
    quaternions = keyframes.as_quat()
    n = len(quaternions)
    still = Rotation.from_quat(quaternions).as_euler("XYZ")
    angles = np.empty(((n - 1) * STRIDE + 1, 3))
    between = angles[:-1].reshape(n - 1, STRIDE, 3)
    between[:] = still[:-1, None]
    angles[-1] = still[-1]
    moving = np.flatnonzero((quaternions[1:] != quaternions[:-1]).any(axis=1))
    between[moving] = _interpolate_intervals(quaternions, moving, moving + 1, moving)
    # As `np.unwrap`, but jumps are few.
    steps = angles[1:] - angles[:-1]
    for row, column in np.argwhere(np.abs(steps) >= np.pi):
        angles[row + 1 :, column] -= 2.0 * np.pi * np.rint(steps[row, column] / (2.0 * np.pi))
    return angles


def _interpolate_intervals(
    quaternions: Array, starts: npt.NDArray[np.int64], ends: npt.NDArray[np.int64], intervals: npt.NDArray[np.int64]
) -> Array:
    """Return the Euler angles (k, STRIDE, 3) between k pairs of rotations, from each first one on.

    As SciPy's Slerp, but several times as fast: rotations of constant axis.

    Args:
        quaternions: (n, 4) rotations at keyframes.
        starts: (k,) indices of the first rotations.
        ends: (k,) indices of the second rotations.
        intervals: (k,) numbers of the keyframes at which the intervals begin.
    """
    angles = np.empty((len(starts), STRIDE, 3))
    for start in range(0, len(starts), _N_INTERVALS):
        rows = slice(start, start + _N_INTERVALS)
        angles[rows] = _interpolate_block(quaternions, starts[rows], ends[rows], intervals[rows])
    return angles


def _interpolate_block(
    quaternions: Array, starts: npt.NDArray[np.int64], ends: npt.NDArray[np.int64], intervals: npt.NDArray[np.int64]
) -> Array:
    """Return the Euler angles of a few intervals, see `_interpolate_intervals`."""
    first = quaternions[starts]
    conjugates = first * [-1.0, -1.0, -1.0, 1.0]
    vectors = Rotation.from_quat(multiply_quaternions(conjugates, quaternions[ends])).as_rotvec()
    begins = (intervals * KEYFRAME_PERIOD)[:, None]
    times = (intervals[:, None] * STRIDE + np.arange(STRIDE)) * (KEYFRAME_PERIOD / STRIDE)
    shares = (times - begins) / (((intervals + 1) * KEYFRAME_PERIOD)[:, None] - begins)
    turns = np.linalg.norm(vectors, axis=1, keepdims=True)
    axes = np.concatenate([vectors / np.maximum(turns, _SMALLEST_TURN), np.zeros_like(turns)], axis=1)
    # A rotation q turned by an angle a about an axis u is q cos(a/2) + q u sin(a/2).
    turned = multiply_quaternions(first, axes)
    cos, sin = np.cos(0.5 * turns * shares), np.sin(0.5 * turns * shares)
    angles = _euler_from_columns(*(cos * first[:, column, None] + sin * turned[:, column, None] for column in range(4)))
    # SciPy decides where the last bit determines the multiple of the grid.
    steps = angles / _GRID
    unsure = np.nonzero((np.abs(steps - np.rint(steps)) > 0.5 - _UNSURE_STEP).any(axis=-1))
    if len(unsure[0]):
        rotations = Rotation.from_rotvec(vectors[unsure[0]] * shares[unsure][:, None])
        angles[unsure] = Rotation.from_quat(multiply_quaternions(first[unsure[0]], rotations.as_quat())).as_euler("XYZ")
    return angles


def _euler_from_columns(x: Array, y: Array, z: Array, w: Array) -> Array:
    """Return intrinsic XYZ Euler angles (..., 3) (rad) of the coordinates (...) of quaternions.

    The method of SciPy (Bernardes and Viollet, 2022), ten times as fast since it is vectorized.
    """
    a, b, c, d = w - y, z - x, w + y, -x - z
    half_sum, half_difference = np.arctan2(b, a), np.arctan2(d, c)
    angles = np.empty((*x.shape, 3))
    angles[..., 0], angles[..., 2] = half_sum + half_difference, half_sum - half_difference
    # To the range from -pi to pi.
    outer = angles[..., ::2]
    outer -= 2.0 * np.pi * np.rint(outer / (2.0 * np.pi))
    angles[..., 0] *= -1.0
    angles[..., 1] = 2.0 * np.arctan2(np.sqrt(c * c + d * d), np.sqrt(a * a + b * b)) - 0.5 * np.pi
    return angles
