"""Intrinsic XYZ Euler angles (rad): R = Rx(x) Ry(y) Rz(z).

Two conversions, because the original uses one library for the fingers' key poses and another for all frames. The
angles' range matters beyond their last bit: where y passes pi / 2, or x is +pi or -pi, the choice decides by how many
turns a whole unwrapped column is shifted.
"""

import math
import sys
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Float64 = npt.NDArray[np.float64]

_LOCKED = 1e-7  # rad; nearer than this to y = +-pi / 2 only the sum or difference of x and z is known
_SMALLEST_COSINE = 4.0 * sys.float_info.epsilon


def angles_of_rotations(rotations: Rotation) -> Float64:
    """Angles (n, 3) as SciPy gave them up to 1.10: through the matrix, x and z in [-pi, pi], y in [-pi/2, pi/2].

    At y = +-pi/2, which may come out 5e-8 beyond, z is zero. Later versions go through the quaternion, which gives
    other signs where x or z is +-pi.
    """
    m = rotations.as_matrix() + 0.0  # no negative zeros, whose sign atan2 would take for that of an angle
    tilt = _each(math.acos, np.clip(m[:, 0, 2], -1.0, 1.0))  # from +x; y = pi / 2 - tilt
    up, down = np.abs(tilt) < _LOCKED, np.abs(tilt - np.pi) < _LOCKED
    safe = ~(up | down)
    x = _each(math.atan2, m[:, 1, 2], -m[:, 2, 2])
    z = _each(math.atan2, m[:, 0, 1], -m[:, 0, 0])
    x[up] = _each(math.atan2, (m[:, 2, 1] + m[:, 1, 0])[up], (m[:, 1, 1] - m[:, 2, 0])[up])
    x[down] = _each(math.atan2, (m[:, 2, 1] - m[:, 1, 0])[down], (m[:, 1, 1] + m[:, 2, 0])[down])
    z[~safe] = 0.0
    y = tilt + np.pi / 2
    # So far y is pi minus what is wanted; turning x and z by half a turn gives the same rotation.
    other = safe & (np.abs(y) > np.pi / 2)
    x[other] += np.pi
    y[other] = np.pi - y[other]
    z[other] -= np.pi
    angles = np.stack([x, y, z], axis=1)
    angles[angles < -np.pi] += 2.0 * np.pi
    angles[angles > np.pi] -= 2.0 * np.pi
    return angles


def angles_of_matrices(matrices: Float64) -> Float64:
    """Angles (n, 3) of rotation matrices (n, 3, 3), y in [-pi/2, pi/2]; where y is +-pi/2, x is zero."""
    m = matrices
    cosine = np.sqrt(m[:, 2, 2] * m[:, 2, 2] + m[:, 1, 2] * m[:, 1, 2])
    safe = cosine > _SMALLEST_COSINE
    x = np.where(safe, -_each(math.atan2, m[:, 1, 2], m[:, 2, 2]), 0.0)
    y = -_each(math.atan2, -m[:, 0, 2], cosine)
    z = -_each(math.atan2, np.where(safe, m[:, 0, 1], -m[:, 1, 0]), np.where(safe, m[:, 0, 0], m[:, 1, 1]))
    return np.stack([x, y, z], axis=1)


def _each(function: Callable[..., float], *columns: Float64) -> Float64:
    # The C library's functions, one by one: NumPy's own for arrays have other last bits on some processors.
    return np.array(list(map(function, *(column.tolist() for column in columns))), dtype=np.float64)
