"""Rotations: unit quaternions (..., 4) xyzw, matrices (..., 3, 3), rotation vectors (..., 3) and Euler angles (..., 3).

Euler angles are intrinsic XYZ angles in rad. Conversions of arrays (n, ...) use SciPy for NumPy arrays, which needs one
batch axis; tensors may have any batch axes, and are converted by the same formulas in double precision.
"""

import warnings

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.arrays import AnyArray, as_arrays, get_namespace, is_tensor, stack_last
from handover_marl.geometry.vectors import compute_lengths

Array = npt.NDArray[np.float64]

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
# Below this angle (rad), series replace divisions by sines.
_SMALL_ANGLE = 1e-3


def normalize_quaternions(quaternions: AnyArray) -> AnyArray:
    """Scale quaternions (..., 4) to length 1."""
    xp = get_namespace(quaternions)
    return quaternions / xp.sqrt(xp.sum(quaternions**2, axis=-1, keepdims=True))


def multiply_quaternions(left: AnyArray, right: AnyArray) -> AnyArray:
    """Compute the Hamilton product of quaternions (..., 4) xyzw: rotate by `right`, then `left`."""
    _, a, b = as_arrays(left, right)
    ax, ay, az, aw = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bx, by, bz, bw = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    return stack_last(
        [
            aw * bx + bw * ax + ay * bz - by * az,
            aw * by + bw * ay + az * bx - bz * ax,
            aw * bz + bw * az + ax * by - bx * ay,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def conjugate_quaternions(quaternions: AnyArray) -> AnyArray:
    """Return the conjugates of quaternions (..., 4) xyzw, float64: the inverse rotations of unit quaternions."""
    _, array, signs = as_arrays(quaternions, _CONJUGATE)
    return array * signs


def rotate_points(quaternions: AnyArray, points: AnyArray) -> AnyArray:
    """Rotate points (..., 3) by unit quaternions (..., 4) xyzw, in double precision."""
    xp, turn, at = as_arrays(quaternions, points)
    turn = xp.astype(turn, xp.float64, copy=False)
    return rotate_and_translate(turn, xp.zeros_like(turn[..., :3]), at)


def rotate_and_translate(quaternions: AnyArray, translations: AnyArray, points: AnyArray) -> AnyArray:
    """Rotate points (..., 3) by unit quaternions (..., 4) xyzw, then add translations (..., 3); nothing is cast."""
    tx, ty, tz = translations[..., 0], translations[..., 1], translations[..., 2]
    x, y, z, w = quaternions[..., 0], quaternions[..., 1], quaternions[..., 2], quaternions[..., 3]
    px, py, pz = points[..., 0], points[..., 1], points[..., 2]
    return stack_last(
        [
            tx + px + 2.0 * (-(y * y + z * z) * px + (x * y - w * z) * py + (w * y + x * z) * pz),
            ty + py + 2.0 * ((w * z + x * y) * px - (x * x + z * z) * py + (y * z - w * x) * pz),
            tz + pz + 2.0 * ((x * z - w * y) * px + (w * x + y * z) * py - (x * x + y * y) * pz),
        ]
    )


def matrices_from_quaternions(quaternions: AnyArray) -> AnyArray:
    """Convert quaternions (n, 4) xyzw, which are normalized first, to rotation matrices (n, 3, 3), float64."""
    if not is_tensor(quaternions):
        return Rotation.from_quat(quaternions).as_matrix()
    unit = normalize_quaternions(quaternions.double())
    x, y, z, w = (unit[..., axis] for axis in range(4))
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return get_namespace(unit).stack([stack_last(row) for row in rows], axis=-2)


def quaternions_from_matrices(matrices: AnyArray) -> AnyArray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) xyzw (Shepperd's method).

    SciPy is not used: its recent versions orthogonalize the matrices first and older ones do not, which changes the
    eighth digit of the results for float32 matrices.
    """
    q = unnormalized_quaternions_from_matrices(matrices)
    return q / get_namespace(q).sqrt(q[..., None, :] @ q[..., :, None])[..., 0]


def unnormalized_quaternions_from_matrices(matrices: AnyArray) -> AnyArray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) xyzw, each times 4 times its largest entry."""
    xp, given = as_arrays(matrices)
    m = xp.astype(given, xp.float64, copy=False)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    largest = xp.argmax(xp.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], trace], axis=-1), axis=-1)
    # Row i is the quaternion times four times its entry i; the largest entry is the most accurate divisor.
    rows = trace.new_empty((*trace.shape, 4, 4)) if is_tensor(trace) else np.empty((*trace.shape, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[..., i, i] = 1.0 - trace + 2.0 * m[..., i, i]
        rows[..., i, j] = rows[..., j, i] = m[..., j, i] + m[..., i, j]
        rows[..., i, 3] = rows[..., 3, i] = m[..., k, j] - m[..., j, k]
    rows[..., 3, 3] = 1.0 + trace
    if is_tensor(rows):
        return xp.take_along_dim(rows, largest[..., None, None], dim=-2)[..., 0, :]
    return np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]


def quaternions_from_rotation_vectors(vectors: AnyArray) -> AnyArray:
    """Convert rotation vectors (n, 3) in rad to unit quaternions (n, 4) xyzw, float64."""
    if not is_tensor(vectors):
        return Rotation.from_rotvec(vectors).as_quat()
    xp, own = get_namespace(vectors), vectors.double()
    angles = compute_lengths(own)
    is_small = angles <= _SMALL_ANGLE
    series = 0.5 - angles**2 / 48.0 + angles**4 / 3840.0
    scale = xp.where(is_small, series, xp.sin(angles / 2.0) / xp.where(is_small, xp.ones_like(angles), angles))
    return xp.concat([scale[..., None] * own, xp.cos(angles / 2.0)[..., None]], axis=-1)


def rotation_vectors_from_quaternions(quaternions: AnyArray) -> AnyArray:
    """Convert quaternions (n, 4) xyzw to rotation vectors (n, 3) of at most pi rad, float64."""
    if not is_tensor(quaternions):
        return Rotation.from_quat(quaternions).as_rotvec()
    xp, unit = get_namespace(quaternions), normalize_quaternions(quaternions.double())
    # Of the two quaternions of a rotation, the one with the smaller angle.
    unit = xp.where(unit[..., 3:] < 0.0, -unit, unit)
    sines = compute_lengths(unit[..., :3])
    angles = 2.0 * xp.atan2(sines, unit[..., 3])
    is_small = angles <= _SMALL_ANGLE
    series = 2.0 + angles**2 / 12.0 + 7.0 * angles**4 / 2880.0
    scale = xp.where(is_small, series, angles / xp.where(is_small, xp.ones_like(sines), sines))
    return scale[..., None] * unit[..., :3]


def compute_rotation_magnitudes(quaternions: AnyArray) -> AnyArray:
    """Compute the rotation angles (n,) of quaternions (n, 4) xyzw, 0 to pi rad, float64."""
    if not is_tensor(quaternions):
        return Rotation.from_quat(quaternions).magnitude()
    return compute_lengths(rotation_vectors_from_quaternions(quaternions))


def compute_rotation_angles(first: npt.ArrayLike, second: npt.ArrayLike) -> Array:
    """Return the angles (...) in rad, 0 to pi, between unit quaternions (..., 4) xyzw, which may have either sign."""
    product = np.vecdot(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    return np.asarray(np.arccos(np.clip(2.0 * product**2 - 1.0, -1.0, 1.0)))


def euler_from_quaternions(quaternions: AnyArray) -> AnyArray:
    """Convert quaternions (n, 4) xyzw to intrinsic XYZ Euler angles (n, 3) (rad)."""
    if is_tensor(quaternions):
        return euler_from_matrices(matrices_from_quaternions(quaternions))
    with warnings.catch_warnings():
        # At gimbal lock the solution is not unique, and any is right.
        warnings.simplefilter("ignore", UserWarning)
        return Rotation.from_quat(quaternions).as_euler("XYZ")


def euler_from_matrices(matrices: AnyArray) -> AnyArray:
    """Convert rotation matrices (..., 3, 3) to intrinsic XYZ Euler angles (..., 3) (rad), y within +-pi/2."""
    xp = get_namespace(matrices)
    sine = xp.clip(matrices[..., 0, 2], -1.0, 1.0)
    is_locked = xp.abs(sine) > 1.0 - 1e-14
    x = xp.atan2(-matrices[..., 1, 2], matrices[..., 2, 2])
    z = xp.atan2(-matrices[..., 0, 1], matrices[..., 0, 0])
    # At gimbal lock, the third angle is 0 as in SciPy.
    x = xp.where(is_locked, xp.atan2(matrices[..., 2, 1], matrices[..., 1, 1]), x)
    return stack_last([x, xp.asin(sine), xp.where(is_locked, xp.zeros_like(z), z)])


def matrices_from_euler(angles: npt.ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of intrinsic XYZ Euler angles (..., 3) (rad)."""
    values = np.asarray(angles, dtype=np.float64)
    (sx, sy, sz), (cx, cy, cz) = np.moveaxis(np.sin(values), -1, 0), np.moveaxis(np.cos(values), -1, 0)
    entries = [
        *(cy * cz, -cy * sz, sy),
        *(cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        *(sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    ]
    return np.stack(entries, axis=-1).reshape(*values.shape, 3)


def quaternions_from_euler(angles: AnyArray) -> AnyArray:
    """Convert XYZ Euler angles (..., 3) in rad to unit quaternions (..., 4) xyzw.

    The result equals SciPy's bit for bit and is computed several times as fast.
    """
    xp, given = as_arrays(angles)
    half = xp.astype(given.reshape(-1, 3), xp.float64, copy=False).T / 2.0
    (sx, sy, sz), (cx, cy, cz) = xp.sin(half), xp.cos(half)
    x, y, z, w = sx * cy, cx * sy, sx * sy, cx * cy
    quaternions = xp.stack([x * cz + y * sz, y * cz - x * sz, z * cz + w * sz, w * cz - z * sz], axis=-1)
    return quaternions.reshape(*given.shape[:-1], 4)


def _euler_solutions(angles: AnyArray) -> AnyArray:
    """Return both triples (n, 2, 3) of XYZ Euler angles (rad) of the rotations `angles` (n, 3), up to full turns."""
    xp, own, half_turns, signs = as_arrays(angles, np.array([np.pi, np.pi, np.pi]), np.array([1.0, -1.0, 1.0]))
    return xp.stack([own, half_turns + own * signs], axis=1)


def find_nearest_euler_branch(angles: AnyArray, previous: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Find the XYZ Euler angles of the rotations `angles` (n, 3) that are nearest to `previous` (n, 3) (rad).

    Two triples of angles give the same rotation, each up to full turns. Returns the number (n,) of the nearest triple,
    0 for the one in `angles` and 1 for the other, and the numbers (n, 3) of full turns to add to this triple.
    """
    xp = get_namespace(angles)
    solutions = _euler_solutions(angles)
    turns = xp.round((previous[:, None] - solutions) / (2.0 * np.pi))
    distances = xp.sum(xp.abs(solutions + 2.0 * np.pi * turns - previous[:, None]), axis=2)
    is_second = distances[:, 1] < distances[:, 0]
    return xp.astype(is_second, xp.int64), xp.where(is_second[:, None], turns[:, 1], turns[:, 0])


def find_nearest_euler(angles: AnyArray, previous: AnyArray) -> AnyArray:
    """Return the XYZ Euler angles (n, 3) in rad nearest to `previous` (n, 3) for the rotations `angles` (n, 3)."""
    xp, solutions = get_namespace(angles), _euler_solutions(angles)
    solution, turns = find_nearest_euler_branch(angles, previous)
    return xp.where(solution[:, None] == 0, solutions[:, 0], solutions[:, 1]) + 2.0 * np.pi * turns
