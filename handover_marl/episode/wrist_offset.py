"""Rigid offset of a recorded hand about its wrist, and set-point tracking with limited speed and acceleration.

Euler angles are intrinsic XYZ; bodies are on chains of three prismatic and three revolute joints.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP, Vector3
from handover_marl.geometry.poses import multiply_quaternions, quaternions_from_euler, unwrap_euler
from handover_marl.geometry.rotations import euler_from_quaternions

Array = npt.NDArray[np.float64]

_TOLERANCE = 1e-6  # units of the tracked vector


def apply_wrist_offset(
    bodies: Sequence[npt.NDArray[np.float32]],
    wrist_in_base: Array,
    displacements: Array,
    rotations: Array,
    previous: Sequence[npt.NDArray[np.float32]],
) -> list[npt.NDArray[np.float32]]:
    """Move a hand and the bodies that it holds rigidly with an offset of the wrist.

    Args:
        bodies: Joint positions of the hand's base and of the bodies that move with it, (n, 6) each: xyz
            (m) and Euler angles (rad).
        wrist_in_base: (3,) position of the wrist in the frame of the hand's base (m).
        displacements: (n, 3) displacements of the wrist, world frame (m).
        rotations: (n, 3) rotation vectors about the wrist, world frame (rad).
        previous: (6,) joint positions of each body before the first row; Euler angles continue from
            them without a jump.
    """
    count, n_rows = len(bodies), len(displacements)
    recorded = np.concatenate(bodies).astype(np.float64)
    orientation = Rotation.from_quat(quaternions_from_euler(recorded[:, 3:]))
    wrist = _transform_wrist(recorded[:n_rows, :3], orientation[:n_rows], wrist_in_base)
    pivots, shifts = np.tile(wrist, (count, 1)), np.tile(displacements, (count, 1))
    rotation = Rotation.from_rotvec(np.tile(rotations, (count, 1)))
    moved = np.empty(recorded.shape)
    moved[:, :3] = pivots + shifts + rotation.apply(recorded[:, :3] - pivots)
    angles = euler_from_quaternions(multiply_quaternions(rotation.as_quat(), orientation.as_quat()))
    for index, before in enumerate(previous):
        rows = slice(index * n_rows, (index + 1) * n_rows)
        moved[rows, 3:] = unwrap_euler(angles[rows], before[3:].astype(np.float64))
    return np.split(moved.astype(np.float32), count)


def compute_wrist_positions(hand_dof: npt.NDArray[np.float32], wrist_in_base: Array) -> Array:
    """Compute positions (n, 3) of a human hand's wrist in the world frame (m).

    Args:
        hand_dof: (n, 6 or more) joint positions of the hand, base first.
        wrist_in_base: (3,) position of the wrist in the frame of the hand's base (m).
    """
    orientation = Rotation.from_quat(quaternions_from_euler(hand_dof[:, 3:6]))
    return _transform_wrist(hand_dof[:, :3], orientation, wrist_in_base)


def _transform_wrist(bases: npt.NDArray[np.floating], orientation: Rotation, wrist_in_base: Array) -> Array:
    positions: Array = bases + orientation.apply(wrist_in_base)
    return positions


class TrackedVector(NamedTuple):
    """Vector (3,) that follows set-points, with its velocity.

    Attributes:
        value: (3,) current value of the vector.
        velocity: (3,) current rate of change of the vector (units/s).
    """

    value: Vector3 = (0.0, 0.0, 0.0)
    velocity: Vector3 = (0.0, 0.0, 0.0)


def track_set_point(
    start: TrackedVector, set_point: npt.ArrayLike, steps: int, max_speed: float, max_acceleration: float
) -> tuple[Array, TrackedVector]:
    """Move a vector towards a set-point, with limited speed and acceleration.

    Args:
        start: Vector before the first step.
        set_point: (3,) value to reach.
        steps: Number of physics steps.
        max_speed: Largest speed (units/s).
        max_acceleration: Largest acceleration (units/s^2).

    Returns:
        The (steps, 3) values and the vector after the last step.
    """
    x, y, z = (float(component) for component in np.asarray(set_point))
    goal = TrackedVector((x, y, z))
    now, values = start, []
    for _ in range(steps):
        if now == goal:
            break
        now = _track_step(now, goal.value, max_speed, max_acceleration)
        values.append(now.value)
    values += [goal.value] * (steps - len(values))
    return np.array(values).reshape(steps, 3), now


def _track_step(now: TrackedVector, goal: Vector3, max_speed: float, max_acceleration: float) -> TrackedVector:
    # Scalars, because arrays of three are slower, and this runs in every physics step.
    (x, y, z), (u, v, w) = now
    left_x, left_y, left_z = goal[0] - x, goal[1] - y, goal[2] - z
    distance = math.hypot(left_x, left_y, left_z)
    max_change = max_acceleration * TIME_STEP
    if distance < _TOLERANCE and math.hypot(u, v, w) <= max_change:
        return TrackedVector(goal)
    # Highest speed that still allows to stop at the goal, in steps of finite length.
    braking = math.sqrt(2.0 * max_acceleration * distance + max_change**2 / 4.0) - max_change / 2.0
    speed = min(max_speed, braking, distance / TIME_STEP)
    if distance > 0.0:
        left_x, left_y, left_z = speed * left_x / distance, speed * left_y / distance, speed * left_z / distance
    change_x, change_y, change_z = left_x - u, left_y - v, left_z - w
    change = math.hypot(change_x, change_y, change_z)
    share = 1.0 if change <= max_change else max_change / change
    u, v, w = u + share * change_x, v + share * change_y, w + share * change_z
    return TrackedVector((x + u * TIME_STEP, y + v * TIME_STEP, z + w * TIME_STEP), (u, v, w))
