"""Between the joints of an object's chain, xyz and XYZ Euler angles, and the free joint that it has in MuJoCo."""

import warnings

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.chain_angles import continued

Array = npt.NDArray[np.float64]

#: Where in MuJoCo's quaternions wxyz the entries of the library's are.
XYZW = [1, 2, 3, 0]


def quaternions_wxyz(angles: npt.NDArray[np.floating]) -> Array:
    """Quaternions (..., 4) wxyz of intrinsic XYZ Euler angles (..., 3) (rad)."""
    half = np.asarray(angles, dtype=np.float64) / 2.0
    (sa, sb, sc), (ca, cb, cc) = np.moveaxis(np.sin(half), -1, 0), np.moveaxis(np.cos(half), -1, 0)
    return np.stack(
        [
            ca * cb * cc - sa * sb * sc,
            sa * cb * cc + ca * sb * sc,
            ca * sb * cc - sa * cb * sc,
            ca * cb * sc + sa * sb * cc,
        ],
        axis=-1,
    )


def chain_joints(free: Array, near: npt.NDArray[np.floating]) -> Array:
    """Joints (m, 6) of chains (m, rad) for free joints.

    Args:
        free: (m, 7) positions (m) and quaternions wxyz.
        near: (m, 6) joints that the angles are to be as near to as can be.
    """
    with warnings.catch_warnings():
        # At gimbal lock any split of the angles will do.
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_quat(free[:, 3:][:, XYZW]).as_euler("XYZ")
    wanted = np.asarray(near[:, 3:], dtype=np.float64)
    rows = [continued(angle[None], last)[0] for angle, last in zip(angles, wanted, strict=True)]
    return np.concatenate([free[:, :3], np.array(rows)], axis=1)


def bullet_quaternion(wxyz: Array) -> Array:
    """The same turns (..., 4) as quaternions xyzw of the sign that Bullet gives them."""
    xyzw = wxyz[..., XYZW]
    w, others = xyzw[..., 3:], xyzw[..., :3]
    # As it reads them off a matrix: w is positive where the trace is, else the largest other.
    largest = np.take_along_axis(others, np.abs(others).argmax(axis=-1)[..., None], axis=-1)
    return np.asarray(np.where(np.where(np.abs(w) > 0.5, w, largest) < 0.0, -xyzw, xyzw))
