"""Rigid poses as arrays (..., 7): position xyz (m) and quaternion xyzw.

A pose `a_from_b` maps coordinates in frame b to coordinates in frame a. Arrays are neither
normalised nor cast: results of float32 arrays are float32, of mixed arrays float64, because the
outcome of an episode can depend on the last bit. Euler angles are intrinsic XYZ angles in rad.

Functions whose arguments are `AnyArray` also take PyTorch tensors, and return tensors on the same device.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.arrays import AnyArray, as_arrays, get_namespace, is_tensor, stack_last

Array = npt.NDArray[np.float64]

#: Identity pose (7,).
IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
IDENTITY.flags.writeable = False
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


def compute_dot_products(first: AnyArray, second: AnyArray) -> AnyArray:
    """Compute the dot products (...) of vectors (..., k), each equal to `np.dot` to the bit."""
    xp, first, second = as_arrays(first, second)
    if is_tensor(first):
        return xp.sum(first * second, axis=-1)
    return np.asarray(np.vecdot(first, second))


def compute_lengths(vectors: AnyArray) -> AnyArray:
    """Compute the lengths (...) of vectors (..., k), each equal to `np.linalg.norm` to the bit."""
    return get_namespace(vectors).sqrt(compute_dot_products(vectors, vectors))


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


def rotate_points(quaternion: AnyArray, points: AnyArray) -> AnyArray:
    """Rotate points (..., 3) by unit quaternions (..., 4) xyzw."""
    xp, turn, at = as_arrays(quaternion, points)
    # Zeros are float64, and so is the result.
    zeros = xp.zeros_like(turn[..., :3], dtype=xp.float64)
    return transform_points(xp.concat([zeros, turn], axis=-1), at)


def transform_points(a_from_b: AnyArray, points: AnyArray) -> AnyArray:
    """Transform points (..., 3) from frame b to frame a by poses `a_from_b` (..., 7)."""
    _, pose, at = as_arrays(a_from_b, points)
    tx, ty, tz = pose[..., 0], pose[..., 1], pose[..., 2]
    x, y, z, w = pose[..., 3], pose[..., 4], pose[..., 5], pose[..., 6]
    px, py, pz = at[..., 0], at[..., 1], at[..., 2]
    return stack_last(
        [
            tx + px + 2.0 * (-(y * y + z * z) * px + (x * y - w * z) * py + (w * y + x * z) * pz),
            ty + py + 2.0 * ((w * z + x * y) * px - (x * x + z * z) * py + (y * z - w * x) * pz),
            tz + pz + 2.0 * ((x * z - w * y) * px + (w * x + y * z) * py - (x * x + y * y) * pz),
        ]
    )


def compute_cross_products(left: npt.ArrayLike, right: npt.ArrayLike) -> Array:
    """Compute the cross products (..., 3) of vectors (..., 3), each equal to `np.cross` to the bit."""
    a, b = np.asarray(left), np.asarray(right)
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.asarray(stack_last([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]))


def quaternion_from_matrix(matrix: AnyArray) -> AnyArray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) xyzw (Shepperd's method).

    Recent SciPy versions orthogonalise the matrix first and older ones do not, which changes the eighth digit for
    matrices stored as float32; this function gives the same bits with every SciPy version.
    """
    q = unnormalized_quaternion_from_matrix(matrix)
    return q / get_namespace(q).sqrt(q[..., None, :] @ q[..., :, None])[..., 0]


def unnormalized_quaternion_from_matrix(matrix: AnyArray) -> AnyArray:
    """Convert rotation matrices (..., 3, 3) to quaternions (..., 4) xyzw without normalisation.

    A quaternion is scaled by 4 times its largest entry.
    """
    xp, given = as_arrays(matrix)
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


def poses_from_matrices(matrices: npt.ArrayLike) -> Array:
    """Convert homogeneous matrices (n, 4, 4) to poses (n, 7), position and quaternion xyzw."""
    transforms = np.asarray(matrices)
    return np.concatenate([transforms[:, :3, 3], quaternion_from_matrix(transforms[:, :3, :3])], axis=-1)


def poses_from_rotations(positions: npt.ArrayLike, rotations: npt.ArrayLike) -> Array:
    """Combine positions (..., 3) and rotation matrices (..., 3, 3) to poses (..., 7) with quaternions xyzw."""
    return np.concatenate([np.asarray(positions), quaternion_from_matrix(rotations)], axis=-1)


def compose(a_from_b: AnyArray, b_from_c: AnyArray) -> AnyArray:
    """Return the product of the poses `a_from_b` and `b_from_c`: the pose `a_from_c` (..., 7)."""
    xp, outer, inner = as_arrays(a_from_b, b_from_c)
    position = transform_points(outer, inner[..., :3])
    return xp.concat([position, multiply_quaternions(outer[..., 3:], inner[..., 3:])], axis=-1)


def invert_pose(a_from_b: AnyArray) -> AnyArray:
    """Return the inverse `b_from_a` (..., 7) of a pose `a_from_b`."""
    xp, pose = as_arrays(a_from_b)
    conjugate = conjugate_quaternions(pose[..., 3:])
    return xp.concat([-rotate_points(conjugate, pose[..., :3]), conjugate], axis=-1)


def inverse_transform_points(a_from_b: AnyArray, points: AnyArray) -> AnyArray:
    """Transform points (..., 3) from frame a to frame b by the inverses of poses `a_from_b`."""
    xp, pose, at = as_arrays(a_from_b, points)
    pose, at = xp.astype(pose, xp.float64, copy=False), xp.astype(at, xp.float64, copy=False)
    return rotate_points(conjugate_quaternions(pose[..., 3:]), at - pose[..., :3])


def compute_rotation_angles(first: npt.ArrayLike, second: npt.ArrayLike) -> Array:
    """Return the angles (...) in rad, 0 to pi, between unit quaternions (..., 4) xyzw, which may have either sign."""
    product = np.vecdot(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    return np.asarray(np.arccos(np.clip(2.0 * product**2 - 1.0, -1.0, 1.0)))


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
    """Return both triples (n, 2, 3) of XYZ Euler angles of each rotation `angles` (n, 3), up to multiples of 2 pi."""
    xp, own, half_turns, signs = as_arrays(angles, np.array([np.pi, np.pi, np.pi]), np.array([1.0, -1.0, 1.0]))
    return xp.stack([own, half_turns + own * signs], axis=1)


def find_nearest_euler_branch(angles: AnyArray, previous: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Select the XYZ Euler angles of the rotations `angles` (n, 3) that are nearest to `previous` (n, 3) (rad).

    Returns which triple is nearest (n,), 0 for the given or 1 for the other one, and the turns (n, 3) to add to it.
    """
    xp = get_namespace(angles)
    solutions = _euler_solutions(angles)
    turns = xp.round((previous[:, None] - solutions) / (2.0 * np.pi))
    distances = xp.sum(xp.abs(solutions + 2.0 * np.pi * turns - previous[:, None]), axis=2)
    is_second = distances[:, 1] < distances[:, 0]
    return xp.astype(is_second, xp.int64), xp.where(is_second[:, None], turns[:, 1], turns[:, 0])


def find_nearest_euler(angles: AnyArray, previous: AnyArray) -> AnyArray:
    """Return the XYZ Euler angles (n, 3) of the rotations with `angles` (n, 3), nearest to `previous` (n, 3) (rad)."""
    xp, solutions = get_namespace(angles), _euler_solutions(angles)
    solution, turns = find_nearest_euler_branch(angles, previous)
    return xp.where(solution[:, None] == 0, solutions[:, 0], solutions[:, 1]) + 2.0 * np.pi * turns


def compute_pose_distances(pose: npt.ArrayLike, poses: Array, rotation_weight: float) -> Array:
    """Compute distances (..., n) in m^2 from poses (..., n, 7) to poses (..., 7), for the ranking of grasps.

    A distance is the squared distance of the positions plus `rotation_weight` (m^2) times 1 - (p . q)^2, where p and q
    are the quaternions.
    """
    one = np.asarray(pose, dtype=np.float64)
    translation: Array = ((poses[..., :3] - one[..., None, :3]) ** 2).sum(axis=-1)
    return translation + rotation_weight * (1.0 - (poses[..., 3:] @ one[..., 3:, None])[..., 0] ** 2)
