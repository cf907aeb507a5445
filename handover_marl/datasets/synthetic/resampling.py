"""Interpolation of keyframes at 25 Hz to joint trajectories at 1 kHz, as in HandoverSim.

Positions are interpolated by cubic splines, rotations by slerp. Angles are intrinsic XYZ Euler
angles (rad), unwrapped for the object and the hand's base.
"""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.config import HAND_DOF
from handover_marl.datasets.synthetic.handover_motion import KEYFRAME_PERIOD, KeyframeMotion

#: Frames of 1 ms between two keyframes.
STRIDE = 40

# Spacing (rad or m) of a grid that values are rounded to. It hides the last bits of sines and
# splines, which differ between machines and versions of NumPy. A power of two, since decimal
# constants in the inputs would give ties.
_GRID = 2.0**-23


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
    fingers = motion.fingers[first:].reshape(-1, 15, 3)
    position = _interpolate_positions(motion.base_position[first:])
    angles = np.unwrap(_interpolate_angles(motion.base_rotation[first:]), axis=0)
    finger_angles = [_interpolate_angles(Rotation.from_euler("XYZ", fingers[:, joint])) for joint in range(15)]
    visible = np.concatenate([position, angles, *finger_angles], axis=1)
    trajectory = np.zeros((first * STRIDE + len(visible), HAND_DOF), dtype=np.float32)
    trajectory[first * STRIDE :] = round_to_grid(visible)
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


def _interpolate_angles(keyframes: Rotation) -> npt.NDArray[np.float64]:
    keyframe_times, times = _sample_times(len(keyframes))
    rotations = Slerp(keyframe_times, keyframes)(np.minimum(times, keyframe_times[-1]))
    return np.asarray(rotations.as_euler("XYZ"))
