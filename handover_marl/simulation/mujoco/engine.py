"""Settings and warnings of MuJoCo, and conversions between its quaternions wxyz and this library's xyzw."""

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.errors import SimulationError
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.geometry.arrays import AnyArray, get_namespace, is_tensor
from handover_marl.geometry.rotations import euler_from_quaternions, find_nearest_euler, quaternions_from_euler


def configure_engine() -> None:
    """Disable MuJoCo's warning output in this process, unless the program has set a handler.

    MuJoCo writes warnings to the console and to a log in the working folder; `check_warnings` reports them instead.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda message: None)


def check_warnings(batch: Batch, count: int = 1) -> None:
    """Raise `SimulationError` if MuJoCo warned in one of the first `count` worlds of a batch."""
    warned = np.flatnonzero(batch.warning[:count, :, 1].any(axis=1))
    if not len(warned):
        return
    details, counts = batch.warning[warned[0]].T
    found = [mujoco.mju_warningText(kind, details[kind]) for kind in np.flatnonzero(counts)]
    advice = "run this scene with physics='fast'" if is_pybullet_installed() else "leave this scene out"
    raise SimulationError(f"MuJoCo's simulation failed: {' '.join(found)} To go on, {advice}, and report this.")


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
    """Convert quaternions (..., 4) from wxyz to xyzw, with the signs (q or -q) that Bullet would return."""
    xp, xyzw = get_namespace(wxyz), wxyz[..., XYZW]
    w, others = xyzw[..., 3:], xyzw[..., :3]
    # Bullet computes quaternions from matrices: w is positive if the trace is, else the largest other component is.
    place = xp.argmax(xp.abs(others), axis=-1)[..., None]
    largest = xp.take_along_dim(others, place, -1) if is_tensor(others) else np.take_along_axis(others, place, axis=-1)
    return xp.where(xp.where(xp.abs(w) > 0.5, w, largest) < 0.0, -xyzw, xyzw)


def chain_joints_from_poses(poses: Array, reference: npt.NDArray[np.floating]) -> Array:
    """Convert poses (n, 7) of objects, xyz (m) and quaternions wxyz, to joints (n, 6): xyz (m), XYZ Euler angles (rad).

    Of equivalent angles, those nearest to the angles of the joint positions `reference` (n, 6) are returned.
    """
    angles = euler_from_quaternions(poses[:, 3:][:, XYZW])
    return np.concatenate([poses[:, :3], find_nearest_euler(angles, np.asarray(reference[:, 3:], np.float64))], axis=1)
