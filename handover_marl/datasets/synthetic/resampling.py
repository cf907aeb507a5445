"""From key poses at 25 Hz to the 1 kHz joint trajectories that the simulator follows, as HandoverSim does it.

Positions by interpolating cubic splines, rotations by slerp, then intrinsic XYZ Euler angles, unwrapped for the
object and the hand's base.
"""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.config import HAND_DOF
from handover_marl.datasets.synthetic.handing_over import KEY_PERIOD, KeyMotion

#: Frames of 1 ms between two key poses.
STRIDE = 40

# Angles and metres are rounded to this grid, so that the last bits of sines and splines, which differ between
# machines and versions of NumPy, are gone. A power of two, because decimal figures in the inputs would make ties.
_GRID = 2.0**-23


def object_trajectory(motion: KeyMotion) -> npt.NDArray[np.float32]:
    """(T, 6) xyz (m) and XYZ Euler angles (rad) of the given object."""
    position = _spline(motion.object_position)
    angles = np.unwrap(_slerp(motion.object_rotation).as_euler("XYZ"), axis=0)
    return rounded(np.concatenate([position, angles], axis=1))


def hand_trajectory(motion: KeyMotion) -> npt.NDArray[np.float32]:
    """(T, 51) base xyz (m), base angles and 45 finger angles (rad); zero where there is no hand."""
    first = motion.hand_first
    joints = motion.fingers[first:].reshape(-1, 15, 3)
    shown = np.concatenate(
        [
            _spline(motion.base_position[first:]),
            np.unwrap(_slerp(motion.base_rotation[first:]).as_euler("XYZ"), axis=0),
            *(_slerp(Rotation.from_euler("XYZ", joints[:, joint])).as_euler("XYZ") for joint in range(15)),
        ],
        axis=1,
    )
    trajectory = np.zeros((first * STRIDE + len(shown), HAND_DOF), dtype=np.float32)
    trajectory[first * STRIDE :] = rounded(shown)
    return trajectory


def _times(n_keys: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    keys = np.arange(n_keys, dtype=np.float64) * KEY_PERIOD
    return keys, np.arange((n_keys - 1) * STRIDE + 1, dtype=np.float64) * (KEY_PERIOD / STRIDE)


def _spline(keys: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    key_times, times = _times(len(keys))
    return np.asarray(CubicSpline(key_times, keys)(times))


def _slerp(keys: Rotation) -> Rotation:
    key_times, times = _times(len(keys))
    return Slerp(key_times, keys)(np.minimum(times, key_times[-1]))


def rounded(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Values on the grid, without negative zeros."""
    return (np.round(np.asarray(values, dtype=np.float64) / _GRID) * _GRID + 0.0).astype(np.float32)
