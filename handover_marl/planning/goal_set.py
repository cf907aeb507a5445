"""Goal sets of the OMG planner: arm configurations at grasps, and the online selection among them.

Each goal comes with a tail, the straight approach to its grasp from a standoff.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.arm import ArmKinematics, LinkFrames, transform_body_points
from handover_marl.geometry.poses import compose
from handover_marl.planning.ik_solvers import solve_ik
from handover_marl.planning.planner_config import GoalSelectionConfig, PlannerConfig
from handover_marl.planning.trajectory_cost import Obstacle, ObstacleCost

Array = npt.NDArray[np.float64]
Limits = tuple[Array, Array]

_N_FINGERS = 2
_LAST_JOINT = 6
#: Number of last goals that the original never checks for collisions; see `PlannerConfig.unchecked_last`.
UNCHECKED = 5


def is_usable_grasp(object_name: str, grasps: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the grasps (n, 7) that OMG uses; for some objects, grasps that slip are excluded."""
    rule = _RULES.get(object_name)
    if rule is None:
        return np.ones(len(grasps), dtype=bool)
    tilts = np.abs(Rotation.from_quat(grasps[:, 3:]).as_euler("xyz")[:, 1])
    return rule(grasps[:, :3], tilts)


def _is_usable_on_scissors(positions: Array, tilts: Array) -> npt.NDArray[np.bool_]:
    x, y, z = np.abs(positions).T
    return np.asarray((z > 0.09) & (y > 0.02) & (x < 0.05) & (tilts > 0.06))


# Rules on positions (n, 3) in m and absolute middle Euler angles (n,) in rad, static xyz axes.
_RULES: dict[str, Callable[[Array, Array], npt.NDArray[np.bool_]]] = {
    "037_scissors": _is_usable_on_scissors,
    "024_bowl": lambda positions, tilts: tilts > np.radians(30.0),
    "025_mug": lambda positions, tilts: tilts > np.radians(15.0),
}


@dataclass(frozen=True, eq=False)
class GoalSet:
    """Arm configurations at grasps, the goals at which a trajectory may end.

    Attributes:
        tails: (g, t, 7) configurations on the approach from the standoff to the grasp (rad).
        grasps: (g,) index of each goal's grasp among the grasps that were given to the builder.
        clearances: (g,) smallest clearance of the gripper to the person's hand in the tail (m),
            infinite where the hand is ignored.
    """

    tails: Array
    grasps: npt.NDArray[np.int_]
    clearances: Array

    def __len__(self) -> int:
        return len(self.tails)

    @property
    def standoffs(self) -> Array:
        """(g, 7) configurations at the standoffs, where the approaches to the grasps start (rad)."""
        return self.tails[:, 0]

    @property
    def goals(self) -> Array:
        """(g, 7) configurations at the grasps, where the approaches end (rad)."""
        return self.tails[:, -1]

    def select(self, chosen: npt.NDArray[np.generic]) -> "GoalSet":
        """Return a goal set that contains only the goals with the given indices or flags."""
        return GoalSet(self.tails[chosen], self.grasps[chosen], self.clearances[chosen])


class GoalSetBuilder:
    """Builder of goal sets by inverse kinematics, collision checks and removal of near duplicates.

    Args:
        arm: Kinematics of the arm.
        body: (m, 3) points on each link of the arm, in the link's frame (m).
        gripper: (m, 3) points on the robot's hand and on each finger (m), from which clearances to
            the person's hand are computed.
        start: (7,) configuration at which motions start (rad).
        limits: Lower and upper joint limits with padding, (7,) each (rad).
        config: Configuration of the planner.
    """

    def __init__(
        self,
        arm: ArmKinematics,
        body: Sequence[Array],
        gripper: Sequence[Array],
        start: Array,
        limits: Limits,
        config: PlannerConfig,
    ) -> None:
        self._arm, self._body, self._gripper, self._start, self._limits = arm, body, gripper, start, limits
        self._config, self._hand, self._unchecked_last = config.goals, config.hand, config.unchecked_last

    def build(self, grasps: Array, objects: Sequence[Obstacle], person: Obstacle | None) -> GoalSet:
        """Return the goals at which the gripper can grasp an object by grasps (n, 7) in the base frame.

        Goals are ordered by decreasing clearance to the person's hand. Goals with too little clearance are
        excluded if other goals exist.
        """
        goals = self._add_wrist_flips(self._solve_tails(grasps))
        goals = goals.select(self._is_rotated_little(goals.goals))
        goals = goals.select(self._is_collision_free(goals.standoffs, objects))
        if person is not None and self._hand is not None and len(goals):
            goals = replace(goals, clearances=self._compute_clearances(goals.tails, person))
            goals = goals.select(np.argsort(-goals.clearances, kind="stable"))
            least = min(self._hand.min_clearance, float(goals.clearances.max()))
            goals = goals.select(goals.clearances >= least)
        return self._thin_out(goals)

    def _compute_clearances(self, tails: Array, person: Obstacle) -> Array:
        """Return the smallest distances (g,) in m of the gripper to a hand over (g, t, 7) tails."""
        frames = self._arm.compute_link_frames(tails.reshape(-1, tails.shape[-1]))
        hand = len(frames.origins) - len(self._gripper)
        points = transform_body_points(LinkFrames(frames.origins[hand:], frames.rotations[hand:]), self._gripper)
        distances = person.compute_distances(points.reshape(3, -1).astype(np.float32))
        by_point = distances.reshape(points.shape[1], *tails.shape[:2])
        return np.asarray(by_point.min(axis=(0, 2)).astype(np.float64))

    def _solve_tails(self, grasps: Array) -> GoalSet:
        """Return the tails from all IK seeds to all grasps for which IK converges."""
        config = self._config
        seeds = np.array([self._start, *config.ik_seeds])
        numbers = np.repeat(np.arange(len(grasps)), len(seeds))
        joints, solved = self._solve(self._tail_poses(grasps, 0), numbers, np.tile(seeds, (len(grasps), 1)))
        numbers, rows = numbers[solved], [joints[solved]]
        # The grasp is solved from the standoff, then each pose on the way back from the previous.
        for step in (config.n_tail - 1, *range(config.n_tail - 2, -1, -1)):
            joints, solved = self._solve(self._tail_poses(grasps, step), numbers, rows[-1])
            numbers, rows = numbers[solved], [*(row[solved] for row in rows), joints[solved]]
        tails = np.stack([rows[-1], *rows[-2:0:-1]], axis=1) if len(numbers) else np.zeros((0, config.n_tail, 7))
        is_short = np.linalg.norm(np.diff(tails, axis=1), axis=(1, 2)) < config.max_tail_norm
        return GoalSet(tails[is_short], numbers[is_short], np.full(int(is_short.sum()), np.inf))

    def _tail_poses(self, grasps: Array, step: int) -> Array:
        """Return the hand poses (n, 7) at one step of the tails."""
        back = self._config.standoff / self._config.n_tail * (self._config.n_tail - 1 - step)
        return np.asarray(compose(grasps, np.array([0.0, 0.0, -back, 0.0, 0.0, 0.0, 1.0])))

    def _solve(self, poses: Array, numbers: npt.NDArray[np.int_], seeds: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Solve IK for the poses with the given indices, one seed each."""
        rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
        tolerance, iterations = self._config.tolerance, self._config.max_iterations
        return solve_ik(self._arm, poses[numbers, :3], rotations[numbers], seeds, self._limits, tolerance, iterations)

    def _add_wrist_flips(self, goals: GoalSet) -> GoalSet:
        """Append the same grasps with the last joint rotated by pi, within its limits."""
        flipped = goals.tails.copy()
        # All rows are flipped as the first one, so that a tail across zero is not torn apart.
        flipped[..., _LAST_JOINT] -= np.copysign(np.pi, goals.tails[:, :1, _LAST_JOINT])
        low, high = self._limits[0][_LAST_JOINT], self._limits[1][_LAST_JOINT]
        fits = ((low < flipped[..., _LAST_JOINT]) & (flipped[..., _LAST_JOINT] < high)).all(axis=1)
        copies = replace(goals, tails=flipped).select(fits)
        return GoalSet(
            np.concatenate([goals.tails, copies.tails]),
            np.concatenate([goals.grasps, copies.grasps]),
            np.concatenate([goals.clearances, copies.clearances]),
        )

    def _is_rotated_little(self, goals: Array) -> npt.NDArray[np.bool_]:
        """Return whether (g,) the hand stays upright on the straight joint line to each goal."""
        config = self._config
        shares = np.arange(1, config.n_path_checks + 1) / (config.n_path_checks + 1)
        line = self._start + shares[:, None, None] * (goals - self._start)
        rotations = self._arm.compute_chain_frames(line.reshape(-1, 7)).rotations[-1]
        first = self._arm.compute_chain_frames(self._start[None]).rotations[-1][..., 0]
        cosine = (np.einsum("ij,ijn->n", first, rotations) - 1.0) / 2.0
        is_allowed = (cosine >= np.cos(config.max_rotation)) & (rotations[2, 0] >= config.min_hand_x_z)
        return np.asarray(is_allowed.reshape(len(shares), -1).all(axis=0))

    def _is_collision_free(self, standoffs: Array, obstacles: Sequence[Obstacle]) -> npt.NDArray[np.bool_]:
        """Return whether (g,) arm and hand, without fingers, are collision-free at standoffs."""
        points = transform_body_points(self._arm.compute_link_frames(standoffs), self._body)
        points = points[:, : points.shape[1] - _N_FINGERS * len(self._body[0])]
        hits = np.zeros(len(standoffs), dtype=np.int_)
        for obstacle in obstacles:
            distances = obstacle.compute_distances(points.reshape(3, -1).astype(np.float32))
            hits += (distances.reshape(points.shape[1:]) < self._config.collision_distance).sum(axis=0)
        is_free: npt.NDArray[np.bool_] = hits <= self._config.max_collisions
        if self._unchecked_last:
            is_free[-UNCHECKED:] = True
        return is_free

    def _thin_out(self, goals: GoalSet) -> GoalSet:
        """Return goals with different standoffs, in random order and of limited number."""
        kept: list[int] = []
        for number, standoff in enumerate(goals.standoffs):
            distances = np.linalg.norm(goals.standoffs[kept] - standoff, axis=1)
            if (distances >= self._config.min_goal_distance).all():
                kept.append(number)
        order = np.random.default_rng(0).permutation(len(kept))[: self._config.max_goals]
        return goals.select(np.array(kept, dtype=np.int_)[order])


class GoalSelector:
    """Online goal selection by mirror descent over experts (Wang et al., 2020, III-C).

    The selector learns which goal is cheap to reach from the present trajectory. With each round, a
    longer first part of the trajectory is treated as fixed.

    Args:
        cost: Obstacle cost of straight paths.
        goals: (g, 7) goal configurations (rad).
        goal_costs: (g,) cost of each goal in addition to the cost of the path to it.
        n_waypoints: Number of waypoints of a trajectory.
        config: Learning rates and weights.
        unchecked_last: Whether to reproduce the indexing error that `PlannerConfig` describes.
    """

    def __init__(
        self,
        cost: ObstacleCost,
        goals: Array,
        goal_costs: Array,
        n_waypoints: int,
        config: GoalSelectionConfig,
        unchecked_last: bool,
    ) -> None:
        self._cost, self._goals, self._goal_costs = cost, goals, goal_costs
        self._n_waypoints, self._config, self._unchecked_last = n_waypoints, config, unchecked_last
        count = len(goals)
        self._rates = np.array(config.learning_rates) * np.sqrt(np.log(count + 1) / config.n_rounds)
        self._experts = np.full((len(config.learning_rates), count), 1.0 / count)
        self._expert_weights = np.full(len(config.learning_rates), 1.0 / len(config.learning_rates))

    def select_first(self, trajectory: Array) -> int:
        """Return the index of the goal that is cheapest to reach from the first waypoint of a trajectory (w, 7)."""
        return int(np.argmin(self._costs(trajectory, 0)))

    def select_next(self, trajectory: Array, round_number: int) -> int:
        """Update the selection by the goals' present costs in a round, from 1, and return the selected goal's index."""
        costs = self._costs(trajectory, round_number)
        before = self._experts
        self._experts = np.stack(
            [update_weights(expert, rate * costs) for expert, rate in zip(before, self._rates, strict=True)]
        )
        losses = self._experts @ costs + np.abs(self._experts - before).sum(axis=1)
        self._expert_weights = self._expert_weights * np.exp(-losses)
        self._expert_weights /= self._expert_weights.sum()
        return int(np.argmax(self._expert_weights @ self._experts))

    def _costs(self, trajectory: Array, round_number: int) -> Array:
        """Return the costs (g,) of straight paths from a waypoint, with a norm of 1."""
        first = min(int(self._config.lookahead_rate * round_number), self._n_waypoints - 1)
        here, count = trajectory[first], self._n_waypoints - first
        tails = np.zeros((len(self._goals), count), dtype=bool)
        tails[-1 if self._unchecked_last else slice(None), -self._cost.n_tail :] = True
        obstacle_costs = self._cost.evaluate_lines(here, self._goals, count, tails)
        smoothness = self._config.smoothness_weight * ((self._goals - here) ** 2).sum(axis=1)
        costs = obstacle_costs + smoothness + self._goal_costs
        return np.asarray(costs / max(float(np.linalg.norm(costs)), np.finfo(np.float64).tiny))


def update_weights(weights: Array, losses: Array) -> Array:
    """Return weights (n,) after a step of mirror descent on the simplex with shifted entropy.

    Each weight w becomes max(0, (w + d) exp(l - loss) - d) with d = 1 / (4 n + 1), and l such that the new weights
    add up to one. The losses (n,) are scaled by the learning rate.
    """
    shift = 1.0 / (4 * len(weights) + 1)
    scaled = (weights + shift) * np.exp(-losses)
    # With the k largest positive, exp(l) is (1 + k d) over their sum, valid while the k-th is positive.
    descending = np.sort(scaled)[::-1]
    levels = (1.0 + shift * np.arange(1, len(weights) + 1)) / np.cumsum(descending)
    n_positive = int(np.flatnonzero(descending * levels > shift)[-1])
    moved = np.maximum(0.0, scaled * levels[n_positive] - shift)
    return np.asarray(moved / moved.sum())
