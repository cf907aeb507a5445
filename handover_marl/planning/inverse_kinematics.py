"""Inverse kinematics: a batched Newton solver, and the IK solvers that receivers use.

Receivers use PyBullet's solver where it is installed, since only its solutions reproduce the
results of HandoverSim's baselines bit for bit, and the library's own solver otherwise.
"""

import atexit
import importlib
import threading
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, PANDA_DOF, PandaConfig
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.geometry.arm import ArmKinematics, ReachabilityBound
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.geometry.poses import IDENTITY, compose, invert_pose

Array = npt.NDArray[np.float64]

_DAMPING = 1e-9
_MIN_SINE = 1e-9

_UNLIMITED = np.full(ARM_DOF, -np.inf), np.full(ARM_DOF, np.inf)
# Maximum final error of position (m) and rotation (rad), as in PyBullet.
_TOLERANCE = (1e-3, 0.1)
# From far away, PyBullet's damped steps end in other configurations than Newton's own. With this
# damping all but one of 640 queries of `yang2021` (40 scenes of s0 train) are solved where PyBullet
# solves them, 95 % within 0.03 rad of its solution.
_PANDA_DAMPING = 0.1
# Largest joint rotation in one step (rad), as in PyBullet.
_MAX_STEP = np.pi / 4.0
_MAX_ITERATIONS, _MIN_STEP = 500, 3e-4
# Iterations and tolerance of a single query.
_STEP_ITERATIONS, _STEP_TOLERANCE = 20, (1e-4, 1e-3)
# Bounds (m, rad) within which a search may still end at the tolerance.
_REACH_DISTANCE, _REACH_ANGLE = 2e-3, 0.11
# Largest number of robots whose solvers a thread keeps.
_MAX_SOLVERS = 4


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
    """Solve inverse kinematics of many hand poses in the arm's base frame by Newton's method.

    Every iteration solves the linearized problem with the smallest joint motion and clamps the
    result to the joint limits.

    Args:
        arm: Kinematics of the arm.
        positions: (n, 3) wanted positions of the hand link's origin (m).
        rotations: (n, 3, 3) wanted rotations of the hand link; None leaves the rotation free.
        seeds: (n, 7) configuration at which each search starts (rad).
        limits: Lower and upper joint limits, (7,) each (rad).
        tolerance: Maximum error of each component of position (m) and rotation vector (rad), or
            two values for the norms of position and rotation vector.
        iterations: Maximum number of iterations.
        damping: Damping of the steps (m^2); more takes shorter steps that stay nearer to the seed.
        min_step: Joint change in one step below which a search ends without solution (rad).
        max_step: Maximum joint change in one step (rad); longer steps are scaled down.

    Returns:
        Configurations (n, 7) in rad, and whether each one reaches its pose (n,).
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

    Args:
        origins: (3, n) present positions of the hand link (m).
        hand_rotations: (3, 3, n) present rotations of the hand link.
        positions: (3, n) wanted positions (m).
        rotations: (n, 3, 3) wanted rotations.
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
    change: Array = (rows.transpose(0, 2, 1) @ weights)[..., 0]
    return change


class IkSolver(Protocol):
    """Interface of inverse kinematics solvers that iterate until the hand link reaches a pose."""

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array | None:
        """Return arm joints (7,) in rad that bring the hand link to a world pose, or None.

        None is returned if the search does not converge.

        Args:
            start: (9,) joints at which the search starts (rad, m); the fingers are ignored.
            position: (3,) world position of the hand link (m).
            orientation: World quaternion xyzw of the hand link; None leaves the rotation free.
        """


class IkStepper(Protocol):
    """Interface of inverse kinematics solvers that make one query, which may not converge."""

    def solve_step(self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: Array | None = None) -> Array:
        """Return joints (9,) that bring the hand link to a world pose or closer to that pose.

        Args:
            joints: (9,) joints at which the search starts (rad, m).
            position: (3,) world position of the hand link (m).
            orientation: World quaternion xyzw of the hand link; None leaves the rotation free.

        Returns:
            Seven arm joints (rad) and two finger positions without meaning.
        """

    def to_base_frame(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """Transform a pose (7,) of the hand link from the world to the robot's base frame."""

    def to_world_frame(self, base_from_hand: Array) -> Array:
        """Transform a pose (7,) of the hand link from the robot's base frame to the world."""


def make_ik_solver(urdf: Path, config: PandaConfig) -> IkSolver:
    """Create an inverse kinematics solver, PyBullet's where PyBullet is installed.

    Args:
        urdf: Model of the Panda.
        config: Configuration with the world pose of the robot's base.

    Raises:
        SimulationError: The model cannot be read.
    """
    return ThreadIkSolver(urdf, config)


def make_ik_stepper(urdf: Path, config: PandaConfig) -> IkStepper:
    """Create a solver of single queries, PyBullet's where PyBullet is installed.

    Arguments and errors are the same as for `make_ik_solver`.
    """
    stepper: IkStepper = _find_solver("BulletIKStep")(urdf, config)
    return stepper


class _ThreadSolvers(threading.local):
    """Solvers of the current thread by model file, its time of change, and robot configuration."""

    def __init__(self) -> None:
        self.solvers: dict[tuple[Path, int | None, PandaConfig], IkSolver] = {}
        if threading.current_thread() is threading.main_thread():
            # While Python exits, a client of PyBullet cannot disconnect any more.
            atexit.register(self.solvers.clear)


_thread_solvers = _ThreadSolvers()


class ThreadIkSolver:
    """Inverse kinematics by a solver that all policies of a thread share.

    A solver of PyBullet takes 44 to 90 MB, depending on the model, and a process can have 1,024 of them at most.
    Solutions do not depend on earlier queries, so policies that share a solver get the same solutions as with one
    each.

    Args:
        urdf: Model of the Panda.
        config: Configuration with the world pose of the robot's base.

    Raises:
        SimulationError: The model cannot be read.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        # A model that has changed is loaded again.
        self._key = urdf, urdf.stat().st_mtime_ns if urdf.is_file() else None, config
        # Loaded here so that it does not count as planning time.
        self._find()

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array | None:
        """Return arm joints (7,) in rad, or None; see `IkSolver.solve`."""
        return self._find().solve(start, position, orientation)

    def _find(self) -> IkSolver:
        """Return the solver of the current thread, and make it if there is none; threads must not share one."""
        solvers = _thread_solvers.solvers
        if self._key not in solvers:
            if len(solvers) >= _MAX_SOLVERS:
                solvers.pop(next(iter(solvers)))
            urdf, _, config = self._key
            solvers[self._key] = _find_solver("BulletIKSolver")(urdf, config)
        return solvers[self._key]


def _find_solver(bullet_class: str) -> Any:
    if not is_pybullet_installed():
        return PandaIkSolver
    return getattr(importlib.import_module("handover_marl.simulation.bullet.kinematics"), bullet_class)


class PandaIkSolver:
    """Inverse kinematics of a Panda without PyBullet, whose solutions differ slightly.

    Joint limits are ignored, as by `BulletIKSolver` and `BulletIKStep`. Solutions do not depend on
    earlier queries.

    Args:
        urdf: Model of the Panda.
        config: Configuration with the world pose of the robot's base.

    Raises:
        SimulationError: The model cannot be read, or is not a Panda.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        tree = read_tree(urdf)
        self._arm = ArmKinematics(tree)
        self._base = np.array([*config.base_position, *config.base_orientation])
        self._base_from_world = invert_pose(self._base)
        hand = [joint.link for joint in tree.joints].index(HAND_LINK)
        self._reach = ReachabilityBound(tree, hand, self._base)

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array | None:
        """Return arm joints (7,) in rad that bring the hand link to a world pose, see `IkSolver.solve`."""
        if self._reach.is_unreachable(position, orientation, _REACH_DISTANCE, _REACH_ANGLE):
            return None
        joints, solved = self._search(start, position, orientation, _TOLERANCE, _MAX_ITERATIONS, _MIN_STEP)
        return joints if solved else None

    def solve_step(
        self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array:
        """Return joints (9,) that bring the hand link to a world pose or closer to that pose.

        Seven arm joints (rad) are followed by two finger positions, which are zero.

        Args:
            joints: (9,) joints at which the search starts (rad, m).
            position: (3,) world position of the hand link (m).
            orientation: World quaternion xyzw of the hand link; None leaves the rotation free.
        """
        closest, _ = self._search(joints, position, orientation, _STEP_TOLERANCE, _STEP_ITERATIONS, 0.0)
        return np.concatenate([closest, np.zeros(PANDA_DOF - ARM_DOF)])

    def to_base_frame(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """Transform a pose (7,) from the world to the robot's base frame, rounded to float32."""
        return compose(self._base_from_world, world_from_hand).astype(np.float32).astype(np.float64)

    def to_world_frame(self, base_from_hand: Array) -> Array:
        """Transform a pose (7,) from the robot's base frame to the world, rounded to float32."""
        return compose(self._base, base_from_hand).astype(np.float32).astype(np.float64)

    def _search(
        self,
        start: npt.ArrayLike,
        position: npt.ArrayLike,
        orientation: npt.ArrayLike | None,
        tolerance: tuple[float, float],
        iterations: int,
        min_step: float,
    ) -> tuple[Array, bool]:
        """Return the joints (7,) at which a search ends, and whether it reached the pose."""
        pose = np.concatenate([np.asarray(position, np.float64), IDENTITY[3:] if orientation is None else orientation])
        local = compose(self._base_from_world, pose)
        rotation = None if orientation is None else Rotation.from_quat(local[3:]).as_matrix()[None]
        seed = np.asarray(start, dtype=np.float64)[None, :ARM_DOF]
        joints, solved = solve_ik(
            *(self._arm, local[None, :3], rotation, seed, _UNLIMITED, tolerance, iterations),
            damping=_PANDA_DAMPING,
            min_step=min_step,
            max_step=_MAX_STEP,
        )
        return joints[0], bool(solved[0])
