"""Reactive handovers by grasp selection (Yang et al., ICRA 2021), as in HandoverSim.

Every 0.1 s the receiver ranks the object's known grasps by their standoff poses: by the distance to the last selected
pose plus the distance to a preferred pose. It moves to the best reachable standoff and from there straight to the
grasp, closes the fingers and carries the object to the goal. It uses the object's true pose and ignores the hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, auto

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF, CheckedConfig, bounded, check_config
from handover_marl.episode.loop import steps_from_hold_time
from handover_marl.episode.observations import Observation
from handover_marl.geometry import panda
from handover_marl.geometry.arm import IkSolver
from handover_marl.geometry.arrays import (
    NUMPY_ARRAYS,
    ONLY_ROW,
    AnyIndices,
    AnyIntegers,
    ArrayFactory,
    Indices,
    to_numpy,
)
from handover_marl.geometry.poses import compose, compute_squared_pose_distances
from handover_marl.geometry.rotations import compute_rotation_angles
from handover_marl.geometry.vectors import compute_dot_products, compute_lengths
from handover_marl.grasps.known_grasps import GraspTable, load_gripper_poses
from handover_marl.planning.ik_solvers import ThreadIkSolver
from handover_marl.policies.batch import Actions, ArrayPolicy
from handover_marl.policies.policy import (
    PolicyContext,
    Receiver,
    milliseconds_from_wait,
    override_options,
    require_reset,
)

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class YangConfig(CheckedConfig):
    """Constants of the method of Yang et al. (2021), as in HandoverSim.

    Attributes:
        wait: Time at the waiting pose (s).
        decision_period: Time between decisions during the approach (s).
        close_time: Time for which the fingers close (s).
        close_decision_period: Time between decisions while the fingers close (s); longer times make batches faster.
        standoff: (7,) standoff pose (quaternion xyzw) of the hand link, relative to its pose at the grasp.
        preferred_pose: (7,) preferred world pose (quaternion xyzw) of the hand link; standoffs near it cost less.
        rotation_weight: Weight of rotations in a standoff's cost (m^2); see `compute_squared_pose_distances`.
        max_candidates: Maximum number of grasps that are checked for reachability.
        region_width: Distance of the hand link from the line between standoff and grasp below which the link moves
            straight to the grasp (m). It is multiplied by 1 + `region_slope` times the length of the line.
        region_slope: Relative increase of this distance per meter of the line's length (1/m).
        region_max_width: Upper limit of this distance (m).
        angle_tolerance: Maximum rotation error of the hand link near the line and at the grasp (rad).
        step_length: Length of a step from standoff to grasp (m).
        grasp_tolerance: Maximum distance from the grasp at which the fingers close (m).
    """

    wait: float = bounded(3.0, 0.0, 60.0)
    decision_period: float = bounded(0.1, 0.001, 60.0)
    close_time: float = bounded(0.5, 0.0, 60.0)
    close_decision_period: float = bounded(0.001, 0.001, 60.0)
    standoff: tuple[float, ...] = panda.RANKING_STANDOFF
    preferred_pose: tuple[float, ...] = panda.PREFERRED_HAND_POSE
    rotation_weight: float = bounded(panda.RANKING_ROTATION_WEIGHT, 0.0, np.inf)
    max_candidates: int = bounded(panda.MAX_RANKED_GRASPS, 1, np.inf)
    region_width: float = bounded(0.015, 0.0, np.inf)
    region_slope: float = bounded(50.0, 0.0, np.inf)
    region_max_width: float = bounded(0.04, 0.0, np.inf)
    angle_tolerance: float = bounded(float(np.radians(15.0)), 0.0, np.pi)
    step_length: float = bounded(0.05, 0.001, np.inf)
    grasp_tolerance: float = bounded(0.005, 0.0, np.inf)


class YangPhase(IntEnum):
    """Phase of a handover with the method of Yang et al. (2021)."""

    WAIT = auto()
    APPROACH = auto()
    CLOSE = auto()
    RETREAT = auto()


class Yang2021Receiver(ArrayPolicy, Receiver):
    """Receiver `yang2021`, the reactive baseline of Yang et al. (2021).

    The receiver decides every 0.1 s during the approach, every millisecond while the fingers close (the target is then
    the present configuration), and once afterwards. It computes in NumPy arrays, also if the actions are tensors.

    Args:
        context: The robot, the task, the objects and their grasps.
        wait: Time at the waiting pose (s); default: the time in `config`.
        config: Constants of the method.
        options: Other values of numbers in the configuration, such as `step_length=0.03`; see `YangConfig`.

    Attributes:
        phase: (n,) `YangPhase` of each episode.
        selected: (n, 2, 7) world poses (quaternion xyzw) of the hand link at the selected standoff and grasp of each
            episode; nan without a selection.
    """

    name = "yang2021"

    def __init__(
        self, context: PolicyContext, wait: float | None = None, config: YangConfig | None = None, **options: float
    ) -> None:
        super().__init__(context)
        config = YangConfig() if config is None else config
        check_config("config", config, YangConfig)
        self.config = override_options(config, options)
        if wait is not None:
            self.config = replace(self.config, wait=milliseconds_from_wait(wait) / 1000.0)
        self._ik_solver: IkSolver | None = None
        self._table = GraspTable(self._load_grippers)
        self.allocate(1, NUMPY_ARRAYS)

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the state of `count` episodes in NumPy arrays; the factory `arrays` creates the arrays of actions."""
        self._arrays = arrays
        self.phase, self._close_until = np.full(count, int(YangPhase.WAIT)), np.zeros(count)
        self.selected = np.full((count, 2, 7), np.nan)
        # Standoffs selected last, to which the next ones should be near; nan without a selection.
        self._references = np.full((count, 7), np.nan)
        self._goals = np.zeros((count, ARM_DOF))

    def prepare(self, object_names: Sequence[str]) -> None:
        """Read the grasps of the first object, which is handed over."""
        load_gripper_poses(self.context.load_grasps, object_names[0])

    def _load_grippers(self, object_class: int) -> tuple[Array] | None:
        grippers = load_gripper_poses(self.context.load_grasps, self.context.object_names[object_class])
        return None if grippers is None else (grippers,)

    @property
    def wait(self) -> float:
        """Time at the waiting pose (s)."""
        return self.config.wait

    @property
    def planned_goal(self) -> npt.NDArray[np.float64] | None:
        """(2, 7) world poses (quaternion xyzw) of the hand link at standoff and grasp; None except in the approach."""
        selected = self.selected[0].copy()
        return selected if self.phase[0] == YangPhase.APPROACH and not np.isnan(selected).any() else None

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s), infinite during the retreat."""
        return float(self.get_hold_times(ONLY_ROW)[0])

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`; `seed` is ignored, since the receiver is deterministic."""
        if self._ik_solver is None:
            # Loaded here so that it does not count as planning time.
            self._ik_solver = ThreadIkSolver(self.context.panda_urdf, self.context.panda)
        self.phase[row] = YangPhase.WAIT
        self.selected[row], self._references[row] = np.nan, np.nan

    def get_hold_times(self, rows: Indices) -> Array:
        """Return the times (r,) until the next decisions in the episodes `rows` (s), infinite during the retreat."""
        config = self.config
        periods = config.decision_period, config.close_decision_period
        times = np.array([config.wait or config.decision_period, *periods, np.inf])
        return np.take(times, self.phase[rows] - YangPhase.WAIT)

    def count_hold_steps(self, rows: AnyIndices) -> AnyIntegers:
        """Return the numbers (r,) of physics steps until the next decisions in the episodes `rows`."""
        times = self.get_hold_times(to_numpy(rows)).tolist()
        return self._arrays.asarray([steps_from_hold_time(time) for time in times])

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the next target joint positions (r, 9) (rad, m) in the episodes `rows`."""
        rows, observation = to_numpy(rows), {key: to_numpy(values) for key, values in observation.items()}
        time, phase = np.round(observation["time"][:, 0].astype(np.float64), 3), self.phase[rows]
        waits = time < self.config.wait
        phase[~waits & (phase == YangPhase.WAIT)] = YangPhase.APPROACH
        approaches = ~waits & (phase == YangPhase.APPROACH)
        arms = observation["robot_joint_position"][:, :ARM_DOF].astype(np.float64)
        if approaches.any():
            in_region, at_grasp = self._find_places(rows, approaches, observation["gripper_pose"])
            phase[at_grasp] = YangPhase.CLOSE
            self._close_until[rows[at_grasp]] = np.round(time[at_grasp] + self.config.close_time, 3)
            for move, flags in (
                (self._move_to_standoffs, approaches & ~in_region),
                (self._move_to_grasps, in_region & ~at_grasp),
            ):
                if flags.any():
                    found = move(rows[flags], {key: value[flags] for key, value in observation.items()})
                    arms[flags] = np.where(np.isnan(found), arms[flags], found)
        retreats = ~waits & (phase == YangPhase.CLOSE) & (time >= self._close_until[rows])
        if retreats.any():
            phase[retreats] = YangPhase.RETREAT
            goals = np.tile(np.array(self.context.protocol.goal_center, dtype=np.float64), (int(retreats.sum()), 1))
            found = self._solver.solve_many(observation["robot_joint_position"][retreats], goals)
            self._goals[rows[retreats]] = np.where(np.isnan(found), arms[retreats], found)
        self.phase[rows] = phase
        arms = np.where((phase == YangPhase.RETREAT)[:, None], self._goals[rows], arms)
        fingers = np.where(phase >= YangPhase.CLOSE, panda.CLOSED, panda.OPEN)[:, None]
        actions = np.concatenate([arms, fingers, fingers], axis=1)
        return self._arrays.asarray(np.where(waits[:, None], panda.WAITING_JOINTS, actions).astype(np.float32))

    def _find_places(self, rows: Indices, approaches: Flags, hands: npt.NDArray[np.float32]) -> tuple[Flags, Flags]:
        """Return two masks (r,) for hand link poses (r, 7): near the line from standoff to grasp, and at the grasp.

        Both are False where `approaches` (r,) is False, or no grasp is selected.
        """
        config = self.config
        in_region, at_grasp = np.zeros((2, len(rows)), dtype=bool)
        some = np.flatnonzero(approaches & ~np.isnan(self.selected[rows, 0, 0]))
        if len(some):
            hand, (standoff, grasp) = hands[some], self.selected[rows[some]].transpose(1, 0, 2)
            angle = compute_rotation_angles(hand[:, 3:], grasp[:, 3:])
            nearest = np.minimum(compute_rotation_angles(hand[:, 3:], standoff[:, 3:]), angle)
            axis = grasp[:, :3] - standoff[:, :3]
            length = compute_lengths(axis)
            # The projection is divided by the length twice and clipped in between, as in the reference.
            share = np.clip(compute_dot_products(hand[:, :3] - standoff[:, :3], axis) / length, 0.0, 1.0) / length
            distance = compute_lengths(standoff[:, :3] + share[:, None] * axis - hand[:, :3])
            width = np.minimum(config.region_width * (1.0 + config.region_slope * length), config.region_max_width)
            in_region[some] = (distance < width) & (nearest < config.angle_tolerance)
            is_near = compute_lengths(grasp[:, :3] - hand[:, :3]) < config.grasp_tolerance
            at_grasp[some] = in_region[some] & is_near & (angle < config.angle_tolerance)
        return in_region, at_grasp

    def _move_to_standoffs(self, rows: Indices, observation: Observation) -> Array:
        """Store the cheapest reachable standoffs in `selected`; return arm joints (r, 7) in rad there, nan if none."""
        joints = observation["robot_joint_position"]
        arms = np.full((len(joints), ARM_DOF), np.nan)
        index = self._table.find(observation["object_classes"][:, 0])
        known = np.flatnonzero(index >= 0)
        if not len(known):
            return arms
        grippers, is_grasp = self._table.arrays[0][index[known]], self._table.is_grasp[index[known]]
        # In this order: the last bits of the reference depend on it.
        objects = observation["object_poses"][known, :1]
        grasps = compose(compose(objects, grippers), np.array(panda.GRIPPER_FROM_HAND))
        standoffs = compose(grasps, np.array(self.config.standoff))
        costs = self._compute_costs(rows[known], standoffs, observation["gripper_pose"][known])
        order = np.argsort(np.where(is_grasp, costs, np.inf), axis=1, kind="stable")[:, : self.config.max_candidates]
        self._references[rows[known]] = np.nan
        left = np.arange(len(known))
        for rank in range(order.shape[1]):
            left = left[is_grasp[left, order[left, rank]]]
            if not len(left):
                break
            chosen = order[left, rank]
            goals = standoffs[left, chosen]
            found = self._solver.solve_many(joints[known[left]], goals[:, :3], goals[:, 3:])
            is_solved = ~np.isnan(found[:, 0])
            solved = left[is_solved]
            row = rows[known[solved]]
            arms[known[solved]], self._references[row] = found[is_solved], goals[is_solved]
            self.selected[row] = np.stack([goals[is_solved], grasps[solved, chosen[is_solved]]], axis=1)
            left = left[~is_solved]
        return arms

    def _compute_costs(self, rows: Indices, standoffs: Array, hands: npt.NDArray[np.float32]) -> Array:
        """Return the costs (r, n) in m^2 of standoffs (r, n, 7) for hand links with present poses (r, 7)."""
        references, weight = self._references[rows], self.config.rotation_weight
        references = np.where(np.isnan(references), hands, references)
        to_preferred = compute_squared_pose_distances(self.config.preferred_pose, standoffs, weight)
        return compute_squared_pose_distances(references, standoffs, weight) + to_preferred

    def _move_to_grasps(self, rows: Indices, observation: Observation) -> Array:
        """Return the arm joints (r, 7) in rad one step closer to the grasps, nan without an IK solution."""
        hands, grasps, length = observation["gripper_pose"][:, :3], self.selected[rows, 1], self.config.step_length
        offsets = grasps[:, :3] - hands
        distances = compute_lengths(offsets)[:, None]
        # The reference rounds this set-point to float32, like the observed position.
        steps = (hands + offsets / np.maximum(distances, length) * length).astype(np.float32)
        positions = np.where(distances >= length, steps, grasps[:, :3])
        return self._solver.solve_many(observation["robot_joint_position"], positions, grasps[:, 3:])

    @property
    def _solver(self) -> IkSolver:
        return require_reset(self._ik_solver, self.name)
