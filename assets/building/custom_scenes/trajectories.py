"""Trajectories of a scene at 1 kHz, made from recorded poses.

Positions are interpolated by cubic splines and rotations by slerp, as in the official data. Angles are intrinsic XYZ
Euler angles (rad), unwrapped.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.custom_scenes.motion_tables import OBJECT, MotionTable, interpolate_rotations
from handover_marl.assets.hand_model import HandGeometry
from handover_marl.config import HAND_DOF, TIME_STEP
from handover_marl.datasets.synthetic.resampling import round_to_grid

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SceneTrajectory:
    """Motion of a scene as in its file, see `handover_marl.datasets.custom.dataset`.

    Attributes:
        object_dof: (T, n, 6) float32.
        hand_dof: (T, 51) float32.
        hand_span: First and last frame with the hand, -1 without one.
    """

    object_dof: npt.NDArray[np.float32]
    hand_dof: npt.NDArray[np.float32]
    hand_span: tuple[int, int]


def count_frames(table: MotionTable) -> int:
    """Return the number of frames of 1 ms in a recording."""
    return int(np.floor(table.time[-1] / TIME_STEP + 1e-6)) + 1


def make_trajectory(
    table: MotionTable, others: Sequence[str], model: HandGeometry | None, fingers: Array | None
) -> SceneTrajectory:
    """Resample recorded poses to 1 kHz.

    Args:
        table: Recorded poses.
        others: Class names of the other objects, in the order of the scene.
        model: Hand of the person, or None without a hand.
        fingers: (n, 45) finger joint angles (rad) in the rows with the wrist, or None without a hand.
    """
    n_frames = count_frames(table)
    times: Array = np.arange(n_frames, dtype=np.float64) * TIME_STEP
    objects = np.stack([_resample_pose(table.time, table.bodies[name], times) for name in (OBJECT, *others)], axis=1)
    hand, span = np.zeros((n_frames, HAND_DOF), dtype=np.float32), (-1, -1)
    if table.wrist is not None and model is not None and fingers is not None:
        recorded = table.time[slice(*table.wrist_rows)]
        frames = np.flatnonzero((times >= recorded[0] - 1e-9) & (times <= recorded[-1] + 1e-9))
        span = (int(frames[0]), int(frames[-1]))
        base = compute_base_poses(table.wrist, model)
        hand[frames, :6] = _resample_pose(recorded, base, times[frames])
        for joint in range(fingers.shape[1] // 3):
            columns = slice(3 * joint, 3 * joint + 3)
            keys = Rotation.from_euler("XYZ", fingers[:, columns]).as_quat()
            angles = interpolate_rotations(recorded, keys, times[frames]).as_euler("XYZ")
            hand[frames, 6 + 3 * joint : 9 + 3 * joint] = round_to_grid(angles)
    return SceneTrajectory(objects, hand, span)


def compute_base_poses(wrist: Array, model: HandGeometry) -> Array:
    """Return the poses (n, 7) of the hand's base for poses of the wrist, whose axes are the same."""
    offsets = Rotation.from_quat(wrist[:, 3:]).apply(model.palm_offset)
    return np.concatenate([wrist[:, :3] - offsets, wrist[:, 3:]], axis=1)


def _resample_pose(recorded: Array, poses: Array, times: Array) -> npt.NDArray[np.float32]:
    positions = CubicSpline(recorded, poses[:, :3])(np.clip(times, recorded[0], recorded[-1]))
    angles = np.unwrap(interpolate_rotations(recorded, poses[:, 3:], times).as_euler("XYZ"), axis=0)
    return round_to_grid(np.concatenate([positions, angles], axis=1))
