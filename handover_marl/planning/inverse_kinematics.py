"""Inverse kinematics of many poses at once: Newton's method, damped if asked for, within joint limits."""

import numpy as np
import numpy.typing as npt

from handover_marl.models.arm import Arm

Array = npt.NDArray[np.float64]

_DAMPING = 1e-9
_SMALL = 1e-9


def solve(
    arm: Arm,
    positions: Array,
    rotations: Array | None,
    seeds: Array,
    limits: tuple[Array, Array],
    tolerance: float | tuple[float, float],
    iterations: int,
    *,
    damping: float = _DAMPING,
    stall: float = 0.0,
    stride: float = np.inf,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Arm configurations whose hand is at given poses of the base's frame.

    Every step solves the linearised problem with the least motion of the joints and clamps them to their limits.

    Args:
        arm: The arm.
        positions: (n, 3) of the hand's origin (m).
        rotations: (n, 3, 3) of the hand; None if any will do.
        seeds: (n, 7) where each search starts (rad).
        limits: Lowest and highest joints, (7,) each (rad).
        tolerance: On every component of the remaining way (m) and rotation vector (rad); or two, on their lengths.
        iterations: Steps at most.
        damping: Of the steps (m^2): 0 goes straight to where the linearised problem is solved, more takes shorter steps
            that stay nearer to the seed where that is far.
        stall: A search ends that moves no joint by as much in a step (rad).
        stride: Steps that move a joint farther are shortened (rad).

    Returns:
        (n, 7) joints, and (n,) whether they solve the pose.
    """
    joints = np.clip(seeds, *limits)
    solved = np.zeros(len(joints), dtype=bool)
    active = np.arange(len(joints))
    rows = slice(3 if rotations is None else 6)
    for step in range(iterations + 1):
        chain = arm.chain(joints[active])
        # Where any rotation will do, what is asked for is not looked at.
        turns = np.repeat(np.eye(3)[None], len(active), axis=0) if rotations is None else rotations[active]
        error = pose_error(chain.origins[-1], chain.rotations[-1], positions[active].T, turns)[rows]
        there = _near(error, tolerance)
        solved[active[there]] = True
        if there.all() or step == iterations:
            break
        left = ~there
        change = _least_motion(arm.jacobian(chain)[rows][..., left], error[:, left], damping)
        active = active[left]
        if stall:
            moving = np.abs(change).max(axis=1) >= stall
            active, change = active[moving], change[moving]
            if not len(active):
                break
        if np.isfinite(stride):
            change *= stride / np.maximum(np.abs(change).max(axis=1, keepdims=True), stride)
        joints[active] = np.clip(joints[active] + change, *limits)
    return joints, solved


def _near(error: Array, tolerance: float | tuple[float, float]) -> npt.NDArray[np.bool_]:
    """(n,) whether what remains, (3, n) or (6, n), is within the tolerance of `solve`."""
    if not isinstance(tolerance, tuple):
        return np.asarray((np.abs(error) < tolerance).all(axis=0))
    lengths = np.linalg.norm(error.reshape(-1, 3, error.shape[1]), axis=1)
    return np.asarray((lengths < np.array(tolerance)[: len(lengths), None]).all(axis=0))


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


def _least_motion(jacobian: Array, error: Array, damping: float) -> Array:
    """(n, 7) smallest joint changes for (k, 7, n) Jacobians and (k, n) errors."""
    rows = np.ascontiguousarray(jacobian.transpose(2, 0, 1))
    gram = rows @ rows.transpose(0, 2, 1) + damping * np.eye(len(error))
    weights = np.linalg.solve(gram, error.T[..., None])
    change: Array = (rows.transpose(0, 2, 1) @ weights)[..., 0]
    return change
