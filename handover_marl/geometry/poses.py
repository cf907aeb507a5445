"""Rigid poses as arrays (..., 7): position xyz (m) and quaternion xyzw.

A pose `a_from_b` maps coordinates in frame b to coordinates in frame a. Its quaternion must have length 1, and is not
normalized. In `transform_points` and `compose`, results of float32 arrays are float32, because the outcome of an
episode can depend on the last bit. Results of mixed arrays, and of all other functions, are float64.

Functions whose arguments are `AnyArray` also take PyTorch tensors, and return tensors on the same device.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.arrays import AnyArray, as_arrays
from handover_marl.geometry.rotations import (
    conjugate_quaternions,
    multiply_quaternions,
    quaternions_from_matrices,
    rotate_and_translate,
    rotate_points,
)

Array = npt.NDArray[np.float64]

#: Identity pose (7,).
IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
IDENTITY.flags.writeable = False


def transform_points(a_from_b: AnyArray, points: AnyArray) -> AnyArray:
    """Transform points (..., 3) from frame b to frame a by poses `a_from_b` (..., 7)."""
    _, pose, at = as_arrays(a_from_b, points)
    return rotate_and_translate(pose[..., 3:], pose[..., :3], at)


def poses_from_matrices(matrices: npt.ArrayLike) -> Array:
    """Convert homogeneous matrices (n, 4, 4) to poses (n, 7), position and quaternion xyzw."""
    transforms = np.asarray(matrices)
    return poses_from_rotations(transforms[:, :3, 3], transforms[:, :3, :3])


def poses_from_rotations(positions: npt.ArrayLike, rotations: npt.ArrayLike) -> Array:
    """Combine positions (..., 3) and rotation matrices (..., 3, 3) to poses (..., 7) with quaternions xyzw."""
    return np.concatenate([np.asarray(positions), quaternions_from_matrices(rotations)], axis=-1)


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


def compute_squared_pose_distances(pose: npt.ArrayLike, poses: Array, rotation_weight: float) -> Array:
    """Compute distances (..., n) in m^2 between `pose` (..., 7) and each of `poses` (..., n, 7), to rank grasps.

    A distance is the squared distance of the positions plus `rotation_weight` (m^2) times 1 - (p . q)^2, where p
    and q are the quaternions.
    """
    one = np.asarray(pose, dtype=np.float64)
    translation: Array = ((poses[..., :3] - one[..., None, :3]) ** 2).sum(axis=-1)
    return translation + rotation_weight * (1.0 - (poses[..., 3:] @ one[..., 3:, None])[..., 0] ** 2)
