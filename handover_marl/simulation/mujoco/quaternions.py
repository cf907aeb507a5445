"""Conversions between MuJoCo's quaternions, wxyz, and the library's, xyzw."""

import warnings

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.arrays import AnyArray, get_namespace, is_tensor
from handover_marl.geometry.poses import quaternions_from_euler, unwrap_euler

Array = npt.NDArray[np.float64]

#: Indices that reorder a quaternion wxyz to xyzw, and back.
XYZW, WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]


def wxyz_from_xyzw(xyzw: npt.ArrayLike) -> Array:
    """Convert a quaternion (4,) from xyzw to MuJoCo's order wxyz."""
    return np.asarray(xyzw, dtype=np.float64)[WXYZ]


def wxyz_from_euler(angles: AnyArray) -> AnyArray:
    """Convert intrinsic XYZ Euler angles (..., 3) (rad) to quaternions (..., 4) wxyz."""
    return quaternions_from_euler(angles)[..., WXYZ]


def bullet_xyzw_from_wxyz(wxyz: AnyArray) -> AnyArray:
    """Convert quaternions (..., 4) from wxyz to xyzw, with the sign that Bullet returns."""
    xp, xyzw = get_namespace(wxyz), wxyz[..., XYZW]
    w, others = xyzw[..., 3:], xyzw[..., :3]
    # Bullet reads quaternions off a matrix: w is positive if the trace is, else the largest other
    # component.
    place = xp.argmax(xp.abs(others), axis=-1)[..., None]
    largest = xp.take_along_dim(others, place, -1) if is_tensor(others) else np.take_along_axis(others, place, axis=-1)
    return xp.where(xp.where(xp.abs(w) > 0.5, w, largest) < 0.0, -xyzw, xyzw)


def chain_joints_from_poses(poses: Array, reference: npt.NDArray[np.floating]) -> Array:
    """Convert world poses of m objects to joint positions (m, 6): xyz and XYZ Euler angles.

    Args:
        poses: Object positions (m) and quaternions wxyz, (m, 7).
        reference: Joint positions (m, 6) near which equivalent angles are chosen.
    """
    with warnings.catch_warnings():
        # At gimbal lock any of the equivalent angles will do.
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_quat(poses[:, 3:][:, XYZW]).as_euler("XYZ")
    wanted = np.asarray(reference[:, 3:], dtype=np.float64)
    rows = [unwrap_euler(angle[None], last)[0] for angle, last in zip(angles, wanted, strict=True)]
    return np.concatenate([poses[:, :3], np.array(rows)], axis=1)
