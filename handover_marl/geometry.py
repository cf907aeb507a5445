"""Rigid poses as arrays (..., 7): position xyz (m), quaternion xyzw. Float64 inside, nothing is normalised.

A pose `a_from_b` maps coordinates in frame b to coordinates in frame a.
"""

import numpy as np
import numpy.typing as npt


def quaternion_multiply(left: npt.ArrayLike, right: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Hamilton product of quaternions (..., 4) xyzw: the rotation `right`, then `left`."""
    a, b = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    vector_a, vector_b, scalar_a, scalar_b = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    vector = scalar_a * vector_b + scalar_b * vector_a + np.cross(vector_a, vector_b)
    scalar = scalar_a * scalar_b - (vector_a * vector_b).sum(axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def rotate(quaternion: npt.ArrayLike, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Rotate points (..., 3) by unit quaternions (..., 4) xyzw."""
    q, p = np.asarray(quaternion, dtype=np.float64), np.asarray(points, dtype=np.float64)
    vector, scalar = q[..., :3], q[..., 3:]
    twice = 2.0 * np.cross(vector, p)
    return p + scalar * twice + np.cross(vector, twice)


def compose(a_from_b: npt.ArrayLike, b_from_c: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The pose `a_from_c` (..., 7)."""
    outer, inner = np.asarray(a_from_b, dtype=np.float64), np.asarray(b_from_c, dtype=np.float64)
    position = outer[..., :3] + rotate(outer[..., 3:], inner[..., :3])
    return np.concatenate([position, quaternion_multiply(outer[..., 3:], inner[..., 3:])], axis=-1)


def inverse_transform_points(a_from_b: npt.ArrayLike, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Points (..., 3) given in frame a, in frame b's coordinates."""
    pose = np.asarray(a_from_b, dtype=np.float64)
    conjugate = pose[..., 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return rotate(conjugate, np.asarray(points, dtype=np.float64) - pose[..., :3])


def rotation_angle(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Angle (rad, 0 to pi) between two rotations given as quaternions (4) xyzw of either sign."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return float(np.arccos(np.clip(2.0 * np.dot(a, b) ** 2 - 1.0, -1.0, 1.0)))
