"""Moving a recorded hand, and what it holds, rigidly about its wrist."""

import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.chain_angles import continued, quaternions
from handover_marl.models.poses import quaternion_multiply

Array = npt.NDArray[np.float64]


def carried(
    bodies: Sequence[npt.NDArray[np.float32]],
    base_from_wrist: Array,
    shifts: Array,
    turns: Array,
    previous: Sequence[npt.NDArray[np.float32]],
) -> list[npt.NDArray[np.float32]]:
    """The chain positions of bodies that are moved rigidly about a hand's wrist.

    Args:
        bodies: The hand's base and what moves with it, (n, 6) each: xyz (m) and intrinsic XYZ Euler angles (rad) as
            recorded.
        base_from_wrist: (3,) fixed place of the wrist on the hand's base (m).
        shifts: (n, 3) how the wrist moves (m).
        turns: (n, 3) rotation vectors in the world frame (rad).
        previous: (6,) each body's row before the first; Euler angles go on from there without a jump.
    """
    count = len(bodies)
    dof = np.concatenate(bodies).astype(np.float64)
    turned = Rotation.from_quat(quaternions(dof[:, 3:]))
    wrist = _wrists(dof[: len(shifts), :3], turned[: len(shifts)], base_from_wrist)
    pivots, ways = np.tile(wrist, (count, 1)), np.tile(shifts, (count, 1))
    turn = Rotation.from_rotvec(np.tile(turns, (count, 1)))
    moved = np.empty(dof.shape)
    moved[:, :3] = pivots + ways + turn.apply(dof[:, :3] - pivots)
    with warnings.catch_warnings():
        # At gimbal lock any split of the angles will do.
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_quat(quaternion_multiply(turn.as_quat(), turned.as_quat())).as_euler("XYZ")
    for number, before in enumerate(previous):
        rows = slice(number * len(shifts), (number + 1) * len(shifts))
        moved[rows, 3:] = continued(angles[rows], before[3:].astype(np.float64))
    return np.split(moved.astype(np.float32), count)


def wrist_points(hand_dof: npt.NDArray[np.float32], base_from_wrist: Array) -> Array:
    """(n, 3) world positions of the wrist, given (n, 6 or more) joints and its fixed place (3,) on the base joints."""
    return _wrists(hand_dof[:, :3], Rotation.from_quat(quaternions(hand_dof[:, 3:6])), base_from_wrist)


def _wrists(bases: npt.NDArray[np.floating], turned: Rotation, base_from_wrist: Array) -> Array:
    points: Array = bases + turned.apply(base_from_wrist)
    return points
