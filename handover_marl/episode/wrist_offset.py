"""Rigid offsets of recorded hands about their wrists, and set-point tracking with limited speed and acceleration.

An offset is a displacement (3; m) and a rotation vector (3; rad) about the wrist, world frame. A body (base of a hand,
object) is moved by three prismatic and three revolute joints, whose positions are xyz and intrinsic XYZ Euler angles.
"""

import numpy as np

from handover_marl.config import TIME_STEP
from handover_marl.geometry.arrays import AnyArray, get_namespace, is_tensor, to_float64
from handover_marl.geometry.rotations import (
    euler_from_quaternions,
    find_nearest_euler,
    find_nearest_euler_branch,
    multiply_quaternions,
    normalize_quaternions,
    quaternions_from_euler,
    quaternions_from_rotation_vectors,
    rotate_points,
)

_TOLERANCE = 1e-6  # m, rad
# Smallest divisor, in place of the length of a vector that may be zero.
_TINY = 1e-300


def track_set_points(
    values: AnyArray, velocities: AnyArray, set_points: AnyArray, steps: int, limits: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Move the wrist offsets of d givers towards set-points, with limited speed and acceleration.

    Args:
        values: Displacements (m) and rotation vectors (rad) before the first step, (d, 2, 3).
        velocities: Velocities (m/s, rad/s) before the first step, (d, 2, 3).
        set_points: Values to reach, (d, 2, 3).
        steps: Number k of physics steps.
        limits: (2, 2) largest speeds (m/s, rad/s), then accelerations (m/s^2, rad/s^2), of displacement and rotation.

    Returns:
        Values and velocities (d, k, 2, 3) after each step.
    """
    xp = get_namespace(values)
    goal, now, velocity = (array.reshape(-1, 3).T for array in (set_points, values, velocities))
    max_speed, acceleration = (xp.tile(limit, (len(values),)) for limit in limits)
    max_change = acceleration * TIME_STEP
    # A vector can stop after a distance d from at most the speed sqrt(2 a d + c^2) - c. The correction c = a dt / 2 is
    # due to the finite length dt of steps.
    braking_factor, squared_correction, correction = 2.0 * acceleration, max_change**2 / 4.0, max_change / 2.0
    track: list[tuple[AnyArray, AnyArray]] = []
    # Reading tensors of a GPU to see whether all vectors are at rest would take more time than the steps.
    while len(track) < steps and (is_tensor(now) or (now != goal).any() or velocity.any()):
        left = goal - now
        distance = _compute_column_lengths(left)
        is_reached = (distance < _TOLERANCE) & (_compute_column_lengths(velocity) <= max_change)
        speed = xp.minimum(max_speed, xp.sqrt(braking_factor * distance + squared_correction) - correction)
        speed = xp.minimum(speed, distance / TIME_STEP)
        change = left * speed / xp.maximum(distance, _TINY) - velocity
        change = change * xp.minimum(1.0, max_change / xp.maximum(_compute_column_lengths(change), _TINY))
        velocity = velocity + change
        now = xp.where(is_reached, goal, now + velocity * TIME_STEP)
        velocity = xp.where(is_reached, 0.0, velocity)
        track.append((now, velocity))
    track += [(goal, xp.zeros_like(goal))] * (steps - len(track))
    path, speeds = (xp.stack(part).reshape(steps, 3, *values.shape[:2]) for part in zip(*track, strict=True))
    return xp.permute_dims(path, (2, 0, 3, 1)), xp.permute_dims(speeds, (2, 0, 3, 1))


def delay_steps(values: AnyArray, delays: AnyArray) -> AnyArray:
    """Return values (d, k, 2, 3) of k steps, `delays` (d,) steps later: after zeros, and without the last values."""
    xp, (count, steps) = get_namespace(values), values.shape[:2]
    source = xp.arange(steps, device=values.device) - delays[:, None]
    delayed = values[xp.arange(count, device=values.device)[:, None], xp.clip(source, min=0)]
    return xp.where((source >= 0)[..., None, None], delayed, 0.0)


def move_with_wrists(bodies: AnyArray, offsets: AnyArray, wrists_in_base: AnyArray, previous: AnyArray) -> AnyArray:
    """Move the hands and objects of d givers rigidly with the offsets of the givers' wrists.

    Args:
        bodies: Joint positions (d, k, 2, 6) of each hand's base and of its object in k steps: xyz (m), Euler angles
            (rad), float32.
        offsets: Displacements (m) and rotation vectors (rad) of each wrist, (d, k, 2, 3).
        wrists_in_base: (d, 3) positions of the wrists in the frames of the hands' bases (m).
        previous: (d, 2, 3) Euler angles of base and object before the first step; the moved angles continue from
            these without a jump.

    Returns:
        Moved joint positions (d, k, 2, 6), float32.
    """
    xp, (count, steps) = get_namespace(bodies), bodies.shape[:2]
    # Givers are often at rest: compute only the steps that differ from the step before.
    differs = xp.ones_like(bodies[..., 0, 0], dtype=xp.bool)
    is_same = [xp.all(values[:, 1:] == values[:, :-1], axis=(2, 3)) for values in (bodies, offsets)]
    differs[:, 1:] = ~(is_same[0] & is_same[1])
    differs = differs.reshape(-1)
    chosen, places = xp.nonzero(differs)[0], xp.cumsum(xp.astype(differs, xp.int64), axis=0) - 1
    recorded, shifts = to_float64(bodies.reshape(-1, 2, 6)[chosen]), offsets.reshape(-1, 2, 1, 3)[chosen]
    orientations = normalize_quaternions(quaternions_from_euler(recorded[..., 3:]))
    wrists = rotate_points(orientations[:, 0], wrists_in_base[chosen // steps])
    pivots = (recorded[:, 0, :3] + wrists)[:, None]
    rotations = quaternions_from_rotation_vectors(shifts[:, 1, 0])[:, None]
    positions = pivots + shifts[:, 0] + rotate_points(rotations, recorded[..., :3] - pivots)
    angles = euler_from_quaternions(multiply_quaternions(rotations, orientations).reshape(-1, 4)).reshape(-1, 2, 3)
    positions, angles = (values[places].reshape(count, steps, 2, 3) for values in (positions, angles))
    sequences = xp.permute_dims(angles, (0, 2, 1, 3)).reshape(-1, steps, 3)
    continued = _continue_euler(sequences, to_float64(previous).reshape(-1, 3)).reshape(count, 2, steps, 3)
    return xp.astype(xp.concat([positions, xp.permute_dims(continued, (0, 2, 1, 3))], axis=-1), xp.float32)


def _continue_euler(angles: AnyArray, previous: AnyArray) -> AnyArray:
    """Replace m sequences of Euler angles by equivalent ones (m, k, 3) that continue without a jump.

    Of all Euler angles that describe a rotation, the result has those nearest to the angles of the step before, by the
    sum of absolute differences.

    Args:
        angles: Sequences of Euler angles (m, k, 3).
        previous: Angles (m, 3) before the first step.
    """
    xp, (count, steps) = get_namespace(angles), angles.shape[:2]
    # Usually the solution and the full turns that are nearest in the first step are nearest in all: try them first.
    solution, turns = find_nearest_euler_branch(angles[:, 0], previous)
    other = np.pi + xp.stack([angles[..., 0], -angles[..., 1], angles[..., 2]], axis=-1)
    guess = xp.where((solution == 0)[:, None, None], angles, other) + 2.0 * np.pi * turns[:, None]
    before = xp.concat([previous[:, None], guess[:, :-1]], axis=1)
    nearest, nearest_turns = find_nearest_euler_branch(angles.reshape(-1, 3), before.reshape(-1, 3))
    is_right = (nearest.reshape(count, steps) == solution[:, None]) & xp.all(
        nearest_turns.reshape(count, steps, 3) == turns[:, None], axis=-1
    )
    wrong = xp.nonzero(~xp.all(is_right, axis=1))[0]
    if len(wrong):
        last, continued = previous[wrong], []
        for step in range(steps):
            last = find_nearest_euler(angles[wrong, step], last)
            continued.append(last)
        guess[wrong] = xp.stack(continued, axis=1)
    return guess


def _compute_column_lengths(vectors: AnyArray) -> AnyArray:
    """Return the lengths (m,) of vectors (3, m)."""
    x, y, z = vectors * vectors
    return get_namespace(vectors).sqrt(x + y + z)
