"""Rigid offsets of recorded hands about their wrists, and set-point tracking with limited speed and acceleration.

Euler angles are intrinsic XYZ; bodies are on chains of three prismatic and three revolute joints.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP
from handover_marl.geometry.arrays import AnyArray, get_namespace, is_tensor
from handover_marl.geometry.poses import (
    multiply_quaternions,
    quaternions_from_euler,
    rotate_points,
    select_nearest_euler,
    unwrap_euler,
)
from handover_marl.geometry.rotations import euler_from_quaternions

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

_TOLERANCE = 1e-6  # m, rad
# Smallest divisor of vectors that may have no length.
_TINY = 1e-300


class _MotionLimits(NamedTuple):
    """Limits of the motion of m vectors, (m,) each.

    The highest speed from which a vector can stop after a distance d, in steps of finite length, is
    sqrt(braking_factor * d + squared_step_correction) - step_correction.

    Attributes:
        max_speed: Largest speed.
        max_change: Largest change of the velocity in a step: largest acceleration a times length of a step dt.
        braking_factor: Square of the speed per braking distance without steps: 2 a.
        squared_step_correction: Square of `step_correction`: (a dt)^2 / 4.
        step_correction: Correction of the speed, because the velocity changes once a step: a dt / 2.
    """

    max_speed: AnyArray
    max_change: AnyArray
    braking_factor: AnyArray
    squared_step_correction: AnyArray
    step_correction: AnyArray


def track_set_points(
    values: AnyArray, velocities: AnyArray, set_points: AnyArray, steps: int, limits: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Move wrist offsets towards set-points, with limited speed and acceleration.

    Args:
        values: Displacements (m) and rotation vectors (rad) before the first step, (d, 2, 3).
        velocities: Velocities before the first step (d, 2, 3).
        set_points: Values to reach, (d, 2, 3).
        steps: Number k of physics steps.
        limits: Largest speeds and largest accelerations, (2, 2): of displacements, of rotations.

    Returns:
        Values and velocities (k, d, 2, 3) after each step.
    """
    xp = get_namespace(values)
    goal, now, velocity = (array.reshape(-1, 3) for array in (set_points, values, velocities))
    max_speed, acceleration = (xp.tile(limit, (len(values),)) for limit in limits)
    max_change = acceleration * TIME_STEP
    motion_limits = _MotionLimits(max_speed, max_change, 2.0 * acceleration, max_change**2 / 4.0, max_change / 2.0)
    if is_tensor(values):
        # Vectors stay at their goals. Choosing those that still move would have to read tensors of a GPU.
        track = [(now.T, velocity.T, None)]
        for _ in range(steps):
            track.append(_track_step(*track[-1][:2], goal.T, motion_limits))
        path, speeds = (xp.stack([step[k] for step in track[1:]]).swapaxes(1, 2) for k in range(2))
    else:
        path, speeds = _track_moving_vectors(now, velocity, goal, motion_limits, steps)
    shape = (steps, *values.shape)
    return path.reshape(shape), speeds.reshape(shape)


def delay_steps(values: AnyArray, delays: AnyArray) -> AnyArray:
    """Return values (k, d, 2, 3) of k steps that start after delays (d,) (steps), with zeros before."""
    xp, (steps, count) = get_namespace(values), values.shape[:2]
    source = xp.arange(steps, device=values.device)[:, None] - delays
    delayed = values[xp.clip(source, min=0), xp.arange(count, device=values.device)]
    return xp.where((source >= 0)[..., None, None], delayed, 0.0)


def _track_moving_vectors(
    now: Array, velocity: Array, goal: Array, limits: _MotionLimits, steps: int
) -> tuple[Array, Array]:
    """Move vectors (m, 3) towards goals; return values and velocities (k, m, 3). Vectors at rest take no time."""
    path, speeds = np.empty((steps, *goal.shape)), np.empty((steps, *goal.shape))
    path[:], speeds[:] = goal, 0.0
    active = np.flatnonzero((now != goal).any(axis=1) | velocity.any(axis=1))
    now, velocity, goal = now[active].T.copy(), velocity[active].T.copy(), goal[active].T.copy()
    limits = _MotionLimits(*(limit[active] for limit in limits))
    first = 0
    while len(active) and first < steps:
        # The same vectors move until one of them reaches its goal.
        track: list[tuple[Array, Array]] = []
        is_reached = np.zeros(len(active), dtype=bool)
        while first + len(track) < steps and not np.count_nonzero(is_reached):
            now, velocity, is_reached = _track_step(now, velocity, goal, limits)
            track.append((now, velocity))
        rows = slice(first, first + len(track))
        moved, moved_velocity = (np.stack(column).swapaxes(1, 2) for column in zip(*track, strict=True))
        path[rows, active], speeds[rows, active] = moved, moved_velocity
        first, left = rows.stop, ~is_reached
        active, now, velocity, goal = active[left], now[:, left], velocity[:, left], goal[:, left]
        limits = _MotionLimits(*(limit[left] for limit in limits))
    return path, speeds


def _track_step(
    now: AnyArray, velocity: AnyArray, goal: AnyArray, limits: _MotionLimits
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Advance vectors (3, m) by one step; return values, velocities, and which reached the goal."""
    xp, left = get_namespace(now), goal - now
    distance = _compute_column_lengths(left)
    is_reached = (distance < _TOLERANCE) & (_compute_column_lengths(velocity) <= limits.max_change)
    # Highest speed that still allows to stop at the goal, in steps of finite length.
    braking = xp.sqrt(limits.braking_factor * distance + limits.squared_step_correction) - limits.step_correction
    speed = xp.minimum(limits.max_speed, braking)
    speed = xp.minimum(speed, distance / TIME_STEP)
    change = left * speed / xp.maximum(distance, _TINY) - velocity
    change = change * xp.minimum(1.0, limits.max_change / xp.maximum(_compute_column_lengths(change), _TINY))
    velocity = velocity + change
    now = now + velocity * TIME_STEP
    if is_tensor(now) or np.count_nonzero(is_reached):
        now, velocity = xp.where(is_reached, goal, now), xp.where(is_reached, 0.0, velocity)
    return now, velocity, is_reached


def apply_wrist_offsets(
    bodies: Sequence[Float32], wrists_in_base: Array, offsets: Sequence[Array], previous: Float32
) -> list[Float32]:
    """Move hands and held objects rigidly with the offsets of their wrists.

    Args:
        bodies: Joint positions (2, k, 6) of each hand's base and of its object: xyz (m), Euler
            angles (rad). The number k of rows may differ.
        wrists_in_base: (d, 3) positions of the wrists in the frames of the hands' bases (m).
        offsets: Displacements (m) and rotation vectors (rad) of each wrist, (k, 2, 3).
        previous: (d, 2, 6) joint positions of base and object before the first row; Euler angles
            continue from them without a jump.

    Returns:
        Moved joint positions (2, k, 6) of each hand's base and of its object.
    """
    counts = [len(rows) for rows in offsets]
    recorded = np.concatenate(bodies, axis=1).astype(np.float64)
    shifts = np.concatenate(offsets)
    orientation = quaternions_from_euler(recorded[..., 3:].reshape(-1, 3)).reshape(2, -1, 4)
    orientation /= np.sqrt((orientation**2).sum(axis=-1, keepdims=True))
    pivots = recorded[0, :, :3] + rotate_points(orientation[0], np.repeat(wrists_in_base, counts, axis=0))
    rotation = Rotation.from_rotvec(shifts[:, 1]).as_quat()
    moved = np.empty(recorded.shape)
    moved[..., :3] = pivots + shifts[:, 0] + rotate_points(rotation, recorded[..., :3] - pivots)
    turned = multiply_quaternions(rotation, orientation)
    moved[..., 3:] = _continue_euler(turned, counts, previous[..., 3:].astype(np.float64))
    ends = np.cumsum(counts)[:-1].tolist()
    return np.split(moved.astype(np.float32), ends, axis=1)


def compute_wrist_positions(hand_dof: Float32, wrist_in_base: Array) -> Array:
    """Compute positions (n, 3) of a human hand's wrist in the world frame (m).

    Args:
        hand_dof: (n, 6 or more) joint positions of the hand, base first.
        wrist_in_base: (3,) position of the wrist in the frame of the hand's base (m).
    """
    orientation = Rotation.from_quat(quaternions_from_euler(hand_dof[:, 3:6]))
    positions: Array = hand_dof[:, :3] + orientation.apply(wrist_in_base)
    return positions


def _continue_euler(quaternions: Array, counts: list[int], previous: Array) -> Array:
    """Return Euler angles (2, N, 3) of quaternions (2, N, 4) that continue without a jump.

    Args:
        quaternions: Quaternions of d pairs of bodies, one pair's rows after the other.
        counts: Number of rows of each pair.
        previous: (d, 2, 3) angles before the first row of each pair.
    """
    angles: Array = euler_from_quaternions(quaternions.reshape(-1, 4)).reshape(2, -1, 3)
    ends = np.cumsum(counts)
    starts = ends - counts
    # Mostly the same solution and full turns are right in all rows of a body: try those of its first.
    found = select_nearest_euler(angles[:, starts].reshape(-1, 3), previous.swapaxes(0, 1).reshape(-1, 3))
    first = np.repeat(found[0].reshape(2, -1, 1), counts, axis=1)
    turns = np.repeat(found[1].reshape(2, -1, 3), counts, axis=1)
    other = np.pi + angles * [1.0, -1.0, 1.0]
    guess = np.where(first == 0, angles, other) + 2.0 * np.pi * turns
    before = np.roll(guess, 1, axis=1)
    before[:, starts] = previous.swapaxes(0, 1)
    nearest, nearest_turns = select_nearest_euler(angles.reshape(-1, 3), before.reshape(-1, 3))
    is_right = (nearest.reshape(first.shape[:2]) == first[..., 0]) & (nearest_turns.reshape(turns.shape) == turns).all(
        axis=-1
    )
    for number, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        for body in range(2):
            if not is_right[body, start:end].all():
                guess[body, start:end] = unwrap_euler(angles[body, start:end], previous[number, body])
    return guess


def _compute_column_lengths(vectors: AnyArray) -> AnyArray:
    """Return the lengths (m,) of vectors (3, m)."""
    x, y, z = vectors * vectors
    return get_namespace(vectors).sqrt(x + y + z)
