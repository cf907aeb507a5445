"""Inverse kinematics of many hand poses at once by Newton's method."""

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.arm import ArmKinematics

Array = npt.NDArray[np.float64]

_DAMPING = 1e-9
_MIN_SINE = 1e-9


def solve_ik(
    arm: ArmKinematics,
    positions: Array,
    rotations: Array | None,
    seeds: Array,
    limits: tuple[Array, Array],
    tolerance: float | tuple[float, float],
    iterations: int,
    *,
    damping: float = _DAMPING,
    min_step: float = 0.0,
    max_step: float = np.inf,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Solve inverse kinematics of many hand poses in the arm's base frame by Newton's method from seeds (n, 7).

    Every iteration solves the linearized problem with the smallest joint motion and clamps the result to the joint
    limits. Positions (n, 3) are in m; without rotations (n, 3, 3), any serves. The tolerance is the maximum error
    of each component of position (m) and rotation vector (rad), or two values for their norms. More damping (m^2)
    takes shorter steps that stay nearer to the seed. A search ends without solution where a step is below
    `min_step`; steps above `max_step` are scaled down (rad). Returns configurations (n, 7) in rad, and whether each
    one reaches its pose (n,).
    """
    joints = np.clip(seeds, *limits)
    solved = np.zeros(len(joints), dtype=bool)
    active = np.arange(len(joints))
    rows = slice(3 if rotations is None else 6)
    for step in range(iterations + 1):
        chain = arm.compute_chain_frames(joints[active])
        # Any rotation serves where it is left free: its rows of the error are dropped.
        wanted = np.repeat(np.eye(3)[None], len(active), axis=0) if rotations is None else rotations[active]
        error = compute_pose_error(chain.origins[-1], chain.rotations[-1], positions[active].T, wanted)[rows]
        is_reached = _is_within(error, tolerance)
        solved[active[is_reached]] = True
        if is_reached.all() or step == iterations:
            break
        left = ~is_reached
        change = _smallest_motion(arm.compute_jacobian(chain)[rows][..., left], error[:, left], damping)
        active = active[left]
        if min_step:
            is_moving = np.abs(change).max(axis=1) >= min_step
            active, change = active[is_moving], change[is_moving]
            if not len(active):
                break
        if np.isfinite(max_step):
            change *= max_step / np.maximum(np.abs(change).max(axis=1, keepdims=True), max_step)
        joints[active] = np.clip(joints[active] + change, *limits)
    return joints, solved


def _is_within(error: Array, tolerance: float | tuple[float, float]) -> npt.NDArray[np.bool_]:
    """Return whether each error, (3, n) or (6, n), is within the tolerance of `solve_ik`."""
    if not isinstance(tolerance, tuple):
        return np.asarray((np.abs(error) < tolerance).all(axis=0))
    norms = np.linalg.norm(error.reshape(-1, 3, error.shape[1]), axis=1)
    return np.asarray((norms < np.array(tolerance)[: len(norms), None]).all(axis=0))


def compute_pose_error(origins: Array, hand_rotations: Array, positions: Array, rotations: Array) -> Array:
    """Return the errors (6, n) of hand poses: translation (m), then rotation vector (rad).

    Present positions (3, n) and rotations (3, 3, n) are those of `LinkFrames`; wanted rotations are (n, 3, 3).
    """
    difference = np.einsum("nij,kjn->ikn", rotations, hand_rotations)
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
    scale = np.where(sine > _MIN_SINE, 0.5 * angle / np.maximum(sine, _MIN_SINE), 0.5)
    return np.concatenate([positions - origins, twice_sine * scale])


def _smallest_motion(jacobian: Array, error: Array, damping: float) -> Array:
    """Return the smallest joint changes (n, 7) for Jacobians (k, 7, n) and errors (k, n)."""
    rows = np.ascontiguousarray(jacobian.transpose(2, 0, 1))
    gram = rows @ rows.transpose(0, 2, 1) + damping * np.eye(len(error))
    weights = np.linalg.solve(gram, error.T[..., None])
    return np.asarray((rows.transpose(0, 2, 1) @ weights)[..., 0])
