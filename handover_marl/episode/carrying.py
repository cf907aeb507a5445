"""Moving a recorded hand, and what it holds, rigidly about its wrist."""

import warnings

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.chain_angles import continued

Array = npt.NDArray[np.float64]


def turn_about(
    dof: npt.NDArray[np.float32], pivot: Array, shift: Array, turn: Rotation, previous: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """The chain positions of a body that is turned about a point and shifted with it.

    Args:
        dof: (n, 6) xyz (m) and intrinsic XYZ Euler angles (rad) as recorded.
        pivot: (n, 3) world points that the body turns about (m).
        shift: (n, 3) how the points move (m).
        turn: n rotations in the world frame.
        previous: (6,) the row before the first; Euler angles go on from there without a jump.
    """
    moved = np.empty(dof.shape)
    moved[:, :3] = pivot + shift + turn.apply(dof[:, :3] - pivot)
    orientation = turn * Rotation.from_euler("XYZ", dof[:, 3:].astype(np.float64))
    with warnings.catch_warnings():
        # At gimbal lock any split of the angles will do.
        warnings.simplefilter("ignore", UserWarning)
        angles = orientation.as_euler("XYZ")
    moved[:, 3:] = continued(angles, previous[3:].astype(np.float64))
    return moved.astype(np.float32)


def wrist_points(hand_dof: npt.NDArray[np.float32], base_from_wrist: Array) -> Array:
    """(n, 3) world positions of the wrist, given (n, 6 or more) joints and its fixed place (3,) on the base joints."""
    turned = Rotation.from_euler("XYZ", hand_dof[:, 3:6].astype(np.float64)).apply(base_from_wrist)
    points: Array = hand_dof[:, :3] + turned
    return points
