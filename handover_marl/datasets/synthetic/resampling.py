"""Interpolation of keyframes to joint trajectories at 1 kHz, as in HandoverSim.

Positions are interpolated by cubic splines, rotations by slerp. Angles are intrinsic XYZ Euler
angles (rad), unwrapped for objects and the hand's base.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.config import HAND_DOF, TIME_STEP
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.synthetic.clutter import ClutterObject
from handover_marl.datasets.synthetic.handover_motion import KEYFRAME_PERIOD, KeyframeMotion

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

#: Frames of 1 ms between two keyframes.
STRIDE = 40

# Spacing (rad or m) of a grid that values are rounded to. It hides the last bits of sines and splines, which differ
# between machines and versions of NumPy. A power of two, since decimal constants in the inputs would give ties.
_GRID = 2.0**-23


def compute_trajectories(motion: KeyframeMotion, clutter: Sequence[ClutterObject]) -> tuple[Float32, Float32, int]:
    """Return objects (T, n, 6) and hand (T, 51) at 1 kHz in the world frame, and the hand's first frame.

    The keyframes (25 Hz) are in the table's frame; the handed-over object is the first.
    """
    n, first = len(motion.object_position), motion.hand_first
    key_times = np.arange(n, dtype=np.float64) * KEYFRAME_PERIOD
    times = np.arange((n - 1) * STRIDE + 1, dtype=np.float64) * TIME_STEP
    target = resample_poses(key_times, motion.object_position, motion.object_rotation, times)
    object_dof = np.repeat(target[:, None], 1 + len(clutter), axis=1)
    if clutter:
        angles = Rotation.from_matrix(np.stack([item.rotation for item in clutter])).as_euler("XYZ")
        object_dof[:, 1:] = round_to_grid(np.concatenate([[item.position for item in clutter], angles], axis=1))
    hand_first = first * STRIDE
    hand_dof = np.zeros((len(times), HAND_DOF), dtype=np.float32)
    # Times since the hand became visible, which the scenes were made with.
    key_times, times = key_times[: n - first], times[: len(times) - hand_first]
    base = resample_poses(key_times, motion.base_position[first:], motion.base_rotation[first:], times)
    hand_dof[hand_first:] = np.concatenate([base, resample_fingers(key_times, motion.fingers[first:], times)], axis=1)
    object_dof[:, :, 2] += TABLE_HEIGHT
    hand_dof[hand_first:, 2] += TABLE_HEIGHT
    return object_dof, hand_dof, hand_first


def resample_poses(key_times: Array, positions: Array, rotations: Rotation, times: Array) -> Float32:
    """Return positions and unwrapped Euler angles (T, 6) at times (T,) from keyframes at `key_times` (n,)."""
    points = CubicSpline(key_times, positions)(np.clip(times, key_times[0], key_times[-1]))
    angles = np.unwrap(_resample_angles(key_times, rotations, times), axis=0)
    return round_to_grid(np.concatenate([points, angles], axis=1))


def resample_fingers(key_times: Array, fingers: Array, times: Array) -> Float32:
    """Return finger joint angles (T, 45) at times (T,) from keyframes (n, 45) at `key_times` (n,)."""
    joints = np.split(fingers, fingers.shape[1] // 3, axis=1)
    angles = [_resample_angles(key_times, Rotation.from_euler("XYZ", joint), times) for joint in joints]
    return round_to_grid(np.concatenate(angles, axis=1))


def _resample_angles(key_times: Array, rotations: Rotation, times: Array) -> Array:
    """Return the Euler angles (T, 3) of rotations at some times; most of the time many rotations are still."""
    quaternions, still = rotations.as_quat(), rotations.as_euler("XYZ")
    moves = np.flatnonzero((quaternions[1:] != quaternions[:-1]).any(axis=1))
    if not len(moves):
        return np.repeat(still[:1], len(times), axis=0)
    first, last = int(moves[0]), int(moves[-1]) + 1
    is_moving = (times >= key_times[first]) & (times <= key_times[last])
    angles: Array = np.where((times < key_times[first])[:, None], still[0], still[-1])
    slerp = Slerp(key_times[first : last + 1], rotations[first : last + 1])
    angles[is_moving] = slerp(times[is_moving]).as_euler("XYZ")
    return angles


def round_to_grid(values: npt.ArrayLike) -> Float32:
    """Return values rounded to multiples of `_GRID`, without negative zeros."""
    return (np.round(np.asarray(values, dtype=np.float64) / _GRID) * _GRID + 0.0).astype(np.float32)
