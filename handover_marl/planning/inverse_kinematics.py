"""Inverse kinematics of many poses at once: Newton's method within joint limits."""

import numpy as np
import numpy.typing as npt

from handover_marl.models.arm import Arm

Array = npt.NDArray[np.float64]

_DAMPING = 1e-9
_SMALL = 1e-9


def solve(
    arm: Arm,
    positions: Array,
    rotations: Array,
    seeds: Array,
    limits: tuple[Array, Array],
    tolerance: float,
    iterations: int,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Arm configurations whose hand is at given poses of the base's frame.

    Every step solves the linearised problem with the least motion of the joints and clamps them to their limits.

    Args:
        arm: The arm.
        positions: (n, 3) of the hand's origin (m).
        rotations: (n, 3, 3) of the hand.
        seeds: (n, 7) where each search starts (rad).
        limits: Lowest and highest joints, (7,) each (rad).
        tolerance: On every component of the remaining way (m) and rotation vector (rad).
        iterations: Steps at most.

    Returns:
        (n, 7) joints, and (n,) whether they solve the pose.
    """
    joints = np.clip(seeds, *limits)
    solved = np.zeros(len(joints), dtype=bool)
    active = np.arange(len(joints))
    for step in range(iterations + 1):
        chain = arm.chain(joints[active])
        error = pose_error(chain.origins[-1], chain.rotations[-1], positions[active].T, rotations[active])
        there = (np.abs(error) < tolerance).all(axis=0)
        solved[active[there]] = True
        if there.all() or step == iterations:
            break
        left = ~there
        change = _least_motion(arm.jacobian(chain)[..., left], error[:, left])
        active = active[left]
        joints[active] = np.clip(joints[active] + change, *limits)
    return joints, solved


def pose_error(origins: Array, turned: Array, positions: Array, rotations: Array) -> Array:
    """(6, n) way (m) and rotation vector (rad) from poses, (3, n) and (3, 3, n), to (3, n) and (n, 3, 3)."""
    difference = np.einsum("nij,kjn->ikn", rotations, turned)
    twice_sine = np.stack(
        [
            difference[2, 1] - difference[1, 2],
            difference[0, 2] - difference[2, 0],
            difference[1, 0] - difference[0, 1],
        ]
    )
    sine = 0.5 * np.sqrt((twice_sine**2).sum(axis=0))
    cosine = 0.5 * (difference[0, 0] + difference[1, 1] + difference[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine > _SMALL, 0.5 * angle / np.maximum(sine, _SMALL), 0.5)
    return np.concatenate([positions - origins, twice_sine * scale])


def _least_motion(jacobian: Array, error: Array) -> Array:
    """(n, 7) smallest joint changes for (6, 7, n) Jacobians and (6, n) errors."""
    rows = np.ascontiguousarray(jacobian.transpose(2, 0, 1))
    gram = rows @ rows.transpose(0, 2, 1) + _DAMPING * np.eye(6)
    weights = np.linalg.solve(gram, error.T[..., None])
    change: Array = (rows.transpose(0, 2, 1) @ weights)[..., 0]
    return change
