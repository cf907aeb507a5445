"""Conversions of rotations: unit quaternions (..., 4) xyzw, matrices (..., 3, 3) and rotation vectors (..., 3).

NumPy arrays are converted by SciPy, tensors by the same formulas in double precision. Arrays have one batch axis (n,),
tensors may have any.
"""

import warnings

from scipy.spatial.transform import Rotation

from handover_marl.geometry.arrays import AnyArray, get_namespace, is_tensor, stack_last
from handover_marl.geometry.poses import compute_lengths, normalize_quaternions

# Below this angle (rad), series replace divisions by sines.
_SMALL_ANGLE = 1e-3


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
