"""Inverse kinematics of many hand poses at once by damped least squares, and the solvers that receivers use.

Receivers use PyBullet's solver where it is installed, since only its solutions reproduce the
results of HandoverSim's baselines bit for bit, and the library's own solver otherwise.
"""

import atexit
import threading
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, PANDA_DOF, PandaConfig
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.geometry.arm import ArmKinematics, IkSolver, IndependentArmKinematics, ReachabilityBound, as_row
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import IDENTITY, compose, invert_pose

if TYPE_CHECKING:
    from handover_marl.simulation.bullet.kinematics import BulletIKStep

Array = npt.NDArray[np.float64]
#: Solvers with `solve_step`, which takes a few iterations towards one pose and may not converge.
IkStepper: TypeAlias = "BulletIKStep | PandaIkSolver"

_DAMPING = 1e-9
_MIN_SINE = 1e-9
Joints = npt.NDArray[np.floating]
_UNLIMITED = np.full(ARM_DOF, -np.inf), np.full(ARM_DOF, np.inf)
# Maximum final error of position (m) and rotation (rad), as in PyBullet.
_TOLERANCE = (1e-3, 0.1)
# From a distant start, PyBullet's damped steps end in other configurations than undamped ones. With this damping, all
# but one of 640 queries of `yang2021` (40 scenes of s0 train) are solved if PyBullet solves them, 95 % of them within
# 0.03 rad of its solution.
_PANDA_DAMPING = 0.1
# Largest joint rotation in one step (rad), as in PyBullet.
_MAX_STEP = np.pi / 4.0
_MAX_ITERATIONS, _MIN_STEP = 500, 3e-4
# Iterations and tolerance of a single query.
_STEP_ITERATIONS, _STEP_TOLERANCE = 20, (1e-4, 1e-3)
# Remaining errors (m, rad), above the tolerance, beyond which a pose is skipped as unreachable.
_REACH_DISTANCE, _REACH_ANGLE = 2e-3, 0.11
# Largest number of robots whose solvers a thread keeps.
_MAX_SOLVERS = 4
# Largest number of queries without solution that are remembered.
_MAX_UNSOLVED = 1024


def solve_ik(
    arm: ArmKinematics,
    positions: Array,
    rotations: Array | None,
    starts: Array,
    limits: tuple[Array, Array],
    tolerance: float | tuple[float, float],
    iterations: int,
    *,
    damping: float = _DAMPING,
    min_step: float = 0.0,
    max_step: float = np.inf,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Solve inverse kinematics of many hand link poses in the base frame by damped Newton steps.

    Every step solves the linearized problem with the smallest joint motion, and clamps the joints to their limits.

    Args:
        arm: Kinematics of the arm.
        positions: (n, 3) goal positions (m).
        rotations: (n, 3, 3) goal rotation matrices from hand to base frame; None for any orientation.
        starts: (n, 7) configurations at which the searches start (rad).
        limits: Lower and upper joint limits, (7,) each (rad).
        tolerance: One bound on every component of the position error (m) and of the rotation vector to the goal (rad),
            or two bounds on the norms of these two.
        iterations: Maximum number of steps, after which a search has failed.
        damping: Square of the damping factor (m^2); a larger one makes steps shorter, nearer to the start.
        min_step: A search also fails at a step that moves no joint by this angle (rad).
        max_step: Largest joint motion to which a step is scaled down (rad).

    Returns:
        Configurations (n, 7) in rad at which the searches ended, and a mask (n,) of those that reach their pose.
    """
    joints = np.clip(starts, *limits)
    solved = np.zeros(len(joints), dtype=bool)
    active = np.arange(len(joints))
    rows = slice(3 if rotations is None else 6)
    for step in range(iterations + 1):
        chain = arm.compute_chain_frames(joints[active])
        # If the rotation is free, any one will do: its rows of the error are dropped.
        wanted = np.repeat(np.eye(3)[None], len(active), axis=0) if rotations is None else rotations[active]
        error = compute_pose_error(chain.origins[-1], chain.rotations[-1], positions[active].T, wanted)[rows]
        is_reached = _is_within(error, tolerance)
        solved[active[is_reached]] = True
        if is_reached.all() or step == iterations:
            break
        left = ~is_reached
        change = _compute_smallest_joint_change(arm.compute_jacobian(chain)[rows][..., left], error[:, left], damping)
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
    """Return base-frame pose errors (6, n), goal minus present: translations (m), then rotation vectors (rad).

    The present poses are `origins` (3, n) and `hand_rotations` (3, 3, n), as in `LinkFrames`; the goals are `positions`
    (3, n) and `rotations` (n, 3, 3). A rotation by exactly pi gives a zero rotation vector.
    """
    difference = np.einsum("nij,kjn->ikn", rotations, hand_rotations)
    twice_sine = np.stack(
        [difference[2, 1] - difference[1, 2], difference[0, 2] - difference[2, 0], difference[1, 0] - difference[0, 1]]
    )
    sine = 0.5 * np.sqrt((twice_sine**2).sum(axis=0))
    cosine = 0.5 * (difference[0, 0] + difference[1, 1] + difference[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine > _MIN_SINE, 0.5 * angle / np.maximum(sine, _MIN_SINE), 0.5)
    return np.concatenate([positions - origins, twice_sine * scale])


def _compute_smallest_joint_change(jacobian: Array, error: Array, damping: float) -> Array:
    """Return the joint changes (n, 7) of least norm that reduce pose errors (k, n), for Jacobians (k, 7, n)."""
    rows = np.ascontiguousarray(jacobian.transpose(2, 0, 1))
    gram = rows @ rows.transpose(0, 2, 1) + damping * np.eye(len(error))
    weights = np.linalg.solve(gram, error.T[..., None])
    return np.asarray((rows.transpose(0, 2, 1) @ weights)[..., 0])


def make_ik_stepper(urdf: Path, config: PandaConfig) -> IkStepper:
    """Create an IK solver whose method `solve_step` makes only a few iterations, so that it may not converge.

    The solver is PyBullet's if PyBullet is installed, else a `PandaIkSolver`. The Panda's base pose is in `config`.
    """
    if not is_pybullet_installed():
        return PandaIkSolver(urdf, config)
    from handover_marl.simulation.bullet.kinematics import BulletIKStep

    return BulletIKStep(urdf, config)


class _ThreadSolvers(threading.local):
    """Solvers of the current thread by model file, its modification time (ns) and robot configuration."""

    def __init__(self) -> None:
        self.solvers: dict[tuple[Path, int | None, PandaConfig], IkSolver] = {}
        if threading.current_thread() is threading.main_thread():
            # While Python exits, a client of PyBullet cannot disconnect any more.
            atexit.register(self.solvers.clear)


_thread_solvers = _ThreadSolvers()


class ThreadIkSolver(IkSolver):
    """Inverse kinematics by one solver for all policies of a thread: PyBullet's if installed, else `PandaIkSolver`.

    It is shared because each of PyBullet's takes 44 to 90 MB, and a process can have at most 1,024 of them. Solutions
    do not depend on earlier queries. Queries without a solution are remembered, since a search that does not converge
    takes a hundred times as long as others, and a receiver whose arm does not move repeats its query.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        # A model that has changed is loaded again.
        self._key = urdf, urdf.stat().st_mtime_ns if urdf.is_file() else None, config
        self._unsolved: OrderedDict[bytes, None] = OrderedDict()
        # Loaded here so that it does not count as planning time.
        self._find()

    def solve_many(self, starts: Joints, positions: Array, orientations: Array | None = None) -> Array:
        """Return arm joints (n, 7) in rad for n world poses, nan where IK fails; see `IkSolver.solve_many`."""
        parts = [part for part in (starts[:, :ARM_DOF], positions, orientations) if part is not None]
        keys = [row.tobytes() for row in np.concatenate(parts, axis=1, dtype=np.float64)]
        rows = np.flatnonzero([key not in self._unsolved for key in keys])
        found = np.full((len(keys), ARM_DOF), np.nan)
        if len(rows):
            quaternions = None if orientations is None else orientations[rows]
            found[rows] = self._find().solve_many(starts[rows], positions[rows], quaternions)
        for row in rows[np.isnan(found[rows, 0])].tolist():
            self._unsolved[keys[row]] = None
            if len(self._unsolved) > _MAX_UNSOLVED:
                self._unsolved.popitem(last=False)
        return found

    def _find(self) -> IkSolver:
        """Return the solver of the current thread, made at the first call; threads must not share a solver."""
        solvers = _thread_solvers.solvers
        if self._key not in solvers:
            if len(solvers) >= _MAX_SOLVERS:
                solvers.pop(next(iter(solvers)))
            urdf, _, config = self._key
            if is_pybullet_installed():
                from handover_marl.simulation.bullet.kinematics import BulletIKSolver

                solvers[self._key] = BulletIKSolver(urdf, config)
            else:
                solvers[self._key] = PandaIkSolver(urdf, config)
        return solvers[self._key]


class PandaIkSolver(IkSolver):
    """Inverse kinematics of a Panda without PyBullet; 95 % of its solutions are within 0.03 rad of PyBullet's.

    Joint limits are ignored, as by `BulletIKSolver` and `BulletIKStep`. A solution depends, to the last bit, neither on
    earlier queries nor on the other queries of its batch.

    Args:
        urdf: Model of the Panda.
        config: Configuration with the world pose of the robot's base.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        self._arm = IndependentArmKinematics(read_tree(urdf))
        self._base = np.array([*config.base_position, *config.base_orientation])
        self._base_from_world = invert_pose(self._base)
        self._reach = ReachabilityBound(self._base)

    def solve_many(self, starts: Joints, positions: Array, orientations: Array | None = None) -> Array:
        """Return arm joints (n, 7) in rad for n world poses, nan where IK fails; see `IkSolver.solve_many`."""
        found = np.full((len(starts), ARM_DOF), np.nan)
        rows = np.flatnonzero(~self._reach.is_unreachable(positions, orientations, _REACH_DISTANCE, _REACH_ANGLE))
        if len(rows):
            quaternions = None if orientations is None else orientations[rows]
            queries = starts[rows], positions[rows], quaternions
            joints, solved = self._search(*queries, _TOLERANCE, _MAX_ITERATIONS, _MIN_STEP)
            found[rows[solved]] = joints[solved]
        return found

    def solve_step(
        self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array:
        """Return joints (9,) that bring the hand link from `joints` (9,) to a world pose, or closer to it.

        The pose is a position (3,) in m and a quaternion (4,) xyzw, None for any orientation. Seven arm joints (rad)
        are followed by two finger positions, which are zero.
        """
        query = as_row(joints), as_row(position), None if orientation is None else as_row(orientation)
        closest, _ = self._search(*query, _STEP_TOLERANCE, _STEP_ITERATIONS, 0.0)
        return np.concatenate([closest[0], np.zeros(PANDA_DOF - ARM_DOF)])

    def to_base_frame(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """Transform a pose (7,) (quaternion xyzw) from the world to the robot's base frame, rounded to float32."""
        return np.asarray(compose(self._base_from_world, world_from_hand).astype(np.float32).astype(np.float64))

    def to_world_frame(self, base_from_hand: Array) -> Array:
        """Transform a pose (7,) (quaternion xyzw) from the robot's base frame to the world, rounded to float32."""
        return np.asarray(compose(self._base, base_from_hand).astype(np.float32).astype(np.float64))

    def _search(
        self,
        starts: Joints,
        positions: Array,
        orientations: Array | None,
        tolerance: tuple[float, float],
        iterations: int,
        min_step: float,
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the joints (n, 7) at which `solve_ik` ends for world poses, and whether each one reaches its pose."""
        quaternions = np.broadcast_to(IDENTITY[3:], (len(positions), 4)) if orientations is None else orientations
        local = compose(self._base_from_world, np.concatenate([positions, quaternions], axis=1))
        rotations = None if orientations is None else Rotation.from_quat(local[:, 3:]).as_matrix()
        joints = starts[:, :ARM_DOF].astype(np.float64)
        return solve_ik(
            *(self._arm, local[:, :3], rotations, joints, _UNLIMITED, tolerance, iterations),
            damping=_PANDA_DAMPING,
            min_step=min_step,
            max_step=_MAX_STEP,
        )
