"""Rigid poses as arrays (..., 7): position xyz (m), quaternion xyzw.

A pose `a_from_b` maps coordinates in frame b to coordinates in frame a. Nothing is normalised and nothing is
cast: products of float32 entries are float32, mixed ones float64, because a method's set-points, and with them
whole episodes, depend on the last bit.
"""

import numpy as np
import numpy.typing as npt

#: The pose that changes nothing.
IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
IDENTITY.flags.writeable = False


def quaternion_multiply(left: npt.ArrayLike, right: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Hamilton product of quaternions (..., 4) xyzw: the rotation `right`, then `left`."""
    ax, ay, az, aw = _components(left)
    bx, by, bz, bw = _components(right)
    return np.stack(
        [
            aw * bx + bw * ax + ay * bz - by * az,
            aw * by + bw * ay + az * bx - bz * ax,
            aw * bz + bw * az + ax * by - bx * ay,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def rotate(quaternion: npt.ArrayLike, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Rotate points (..., 3) by unit quaternions (..., 4) xyzw."""
    return compose_point(np.concatenate([np.zeros((*np.shape(quaternion)[:-1], 3)), quaternion], axis=-1), points)


def compose_point(a_from_b: npt.ArrayLike, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Points (..., 3) given in frame b, in frame a's coordinates."""
    tx, ty, tz, *quaternion = _components(a_from_b)
    x, y, z, w = quaternion
    px, py, pz = _components(points)
    return np.stack(
        [
            tx + px + 2.0 * (-(y * y + z * z) * px + (x * y - w * z) * py + (w * y + x * z) * pz),
            ty + py + 2.0 * ((w * z + x * y) * px - (x * x + z * z) * py + (y * z - w * x) * pz),
            tz + pz + 2.0 * ((x * z - w * y) * px + (w * x + y * z) * py - (x * x + y * y) * pz),
        ],
        axis=-1,
    )


def quaternion_from_matrix(matrix: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Unit quaternions (..., 4) xyzw of rotation matrices (..., 3, 3), by Shepperd's method.

    SciPy's conversion also orthogonalises in recent versions and not in older ones, which changes the eighth
    digit for matrices stored as float32; this one is the same everywhere.
    """
    q = shepperd_row(matrix)
    unit: npt.NDArray[np.float64] = q / np.sqrt(q[..., None, :] @ q[..., :, None])[..., 0]
    return unit


def shepperd_row(matrix: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The same times four times the quaternion's largest entry."""
    m = np.asarray(matrix, dtype=np.float64)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    largest = np.argmax(np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], trace], axis=-1), axis=-1)
    # Each row is the quaternion times four times one of its entries.
    rows = np.empty((*trace.shape, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[..., i, i] = 1.0 - trace + 2.0 * m[..., i, i]
        rows[..., i, j] = rows[..., j, i] = m[..., j, i] + m[..., i, j]
        rows[..., i, 3] = rows[..., 3, i] = m[..., k, j] - m[..., j, k]
    rows[..., 3, 3] = 1.0 + trace
    row: npt.NDArray[np.float64] = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return row


def poses_from_matrices(matrices: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Poses (n, 7) of homogeneous matrices (n, 4, 4)."""
    transforms = np.asarray(matrices)
    return poses_from_rotations(transforms[:, :3, 3], transforms[:, :3, :3])


def poses_from_rotations(positions: npt.ArrayLike, rotations: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Poses (..., 7) of positions (..., 3) and rotation matrices (..., 3, 3)."""
    return np.concatenate([np.asarray(positions), quaternion_from_matrix(rotations)], axis=-1)


def compose(a_from_b: npt.ArrayLike, b_from_c: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The pose `a_from_c` (..., 7)."""
    outer, inner = np.asarray(a_from_b), np.asarray(b_from_c)
    position = compose_point(outer, inner[..., :3])
    return np.concatenate([position, quaternion_multiply(outer[..., 3:], inner[..., 3:])], axis=-1)


def inverse(a_from_b: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The pose `b_from_a` (..., 7)."""
    pose = np.asarray(a_from_b)
    conjugate = pose[..., 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([-rotate(conjugate, pose[..., :3]), conjugate], axis=-1)


def inverse_transform_points(a_from_b: npt.ArrayLike, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Points (..., 3) given in frame a, in frame b's coordinates."""
    pose = np.asarray(a_from_b, dtype=np.float64)
    conjugate = pose[..., 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return rotate(conjugate, np.asarray(points, dtype=np.float64) - pose[..., :3])


def rotation_angle(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Angle (rad, 0 to pi) between two rotations given as quaternions (4) xyzw of either sign."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return float(np.arccos(np.clip(2.0 * np.dot(a, b) ** 2 - 1.0, -1.0, 1.0)))


def _components(vectors: npt.ArrayLike) -> npt.NDArray[np.floating]:
    return np.moveaxis(np.asarray(vectors), -1, 0)
