"""OMG: manipulation trajectory optimization with online grasp selection (Wang et al., RSS 2020).

The optimizer is goal-set CHOMP (Zucker et al., 2013): covariant gradient steps that keep the end of
a trajectory on the tail of a goal (Wang et al., 2020, section III-B).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.distance_field import sample_distance_field
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import FINGER_LINKS, HAND_LINK, LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.poses import IDENTITY
from handover_marl.planning.goal_set import GoalSelector, GoalSet, GoalSetBuilder, Limits
from handover_marl.planning.hand_tracker import Capsules
from handover_marl.planning.planner_config import ChompConfig, CostConfig, HandAvoidanceConfig, PlannerConfig
from handover_marl.planning.trajectory_cost import Obstacle, ObstacleCost, sample_body_points

Array = npt.NDArray[np.float64]

_HAND_CELL = 0.01  # m


@dataclass(frozen=True, eq=False)
class Plan:
    """Planned trajectory in the robot's base frame.

    Attributes:
        start: (7,) configuration before the first waypoint (rad).
        goals: Goal set from which the goal of the trajectory was selected.
        chosen: Index of the selected goal in `goals`.
        trajectory: (w, 7) waypoints (rad); the last ones are the approach from standoff to grasp.
        steps: Number of optimization steps that were made.
    """

    start: Array
    goals: GoalSet
    chosen: int
    trajectory: Array
    steps: int


class Planner:
    """OMG planner of arm trajectories from one start configuration to a grasp.

    Args:
        panda_urdf: URDF model of the robot.
        start: (7,) configuration at which motions start (rad).
        config: Configuration of the planner.

    Raises:
        SimulationError: The model is not a Panda.
        DataFormatError: A mesh cannot be read.

    Attributes:
        arm: Kinematics of the arm in its base frame.
    """

    def __init__(self, panda_urdf: Path, start: Array, config: PlannerConfig) -> None:
        self.config = config
        self.arm = ArmKinematics(read_tree(panda_urdf))
        padding = config.goals.limit_padding
        joints = self.arm.n_joints
        self._limits = (
            np.array(LOWER_LIMITS[:joints]) + padding,
            np.array(UPPER_LIMITS[:joints]) - padding,
        )
        self._body = sample_body_points(panda_urdf, tuple(self.arm.link_names), config.n_points_per_link)
        self._gripper = sample_body_points(panda_urdf, (HAND_LINK, *FINGER_LINKS), config.n_gripper_points)
        self._start = start
        self._builder = self._make_builder(start)

    def set_start(self, start: Array) -> None:
        """Set the configuration (7,) in rad at which planned trajectories start."""
        self._start, self._builder = start, self._make_builder(start)

    def _make_builder(self, start: Array) -> GoalSetBuilder:
        return GoalSetBuilder(self.arm, self._body, self._gripper, start, self._limits, self.config)

    def plan(self, grasps: Array, objects: Sequence[Obstacle], hand: Capsules | None = None) -> Plan | None:
        """Compute a trajectory to one of the grasps (n, 7) in the base frame; None if none can be reached."""
        config = self.config
        person = None if hand is None or config.hand is None else make_hand_obstacle(hand, config.hand)
        goals = self._builder.build(grasps, objects, person)
        if not len(goals):
            return None
        obstacles = [*objects] if person is None else [*objects, person]
        cost = ObstacleCost(self.arm, self._body, obstacles, config.goals.n_tail, config.costs)
        chomp = Chomp(cost, self._start, self._limits, config.chomp, config.costs)
        n_waypoints, goal_costs = config.chomp.n_waypoints, self._clearance_costs(goals)
        selector = GoalSelector(cost, goals.goals, goal_costs, n_waypoints, config.selection, config.unchecked_last)
        return self._optimize(goals, selector, chomp)

    def _optimize(self, goals: GoalSet, selector: GoalSelector, chomp: "Chomp") -> Plan:
        """Compute a plan by alternating goal selection and trajectory steps."""
        config = self.config.chomp
        first = make_initial_trajectory(self._start, goals.goals[0], config.n_waypoints)
        chosen = selector.select_first(first)
        trajectory = make_initial_trajectory(self._start, goals.goals[chosen], config.n_waypoints)
        max_steps = config.n_selection_steps + config.n_fixed_goal_steps
        for step in range(max_steps):
            if step < config.n_selection_steps:
                chosen = selector.select_next(trajectory, step + 1)
            goal = goals.goals[chosen]
            if step > 0 and chomp.is_finished(trajectory, goal, self.config.goals.collision_distance):
                return Plan(self._start, goals, chosen, trajectory, step)
            trajectory = chomp.step(trajectory, goals.tails[chosen], step + 1)
        return Plan(self._start, goals, chosen, trajectory, max_steps)

    def _clearance_costs(self, goals: GoalSet) -> Array:
        """Return the cost (g,) of each goal's missing clearance to the person's hand."""
        hand = self.config.hand
        if hand is None:
            return np.zeros(len(goals))
        return hand.clearance_cost * np.maximum(0.0, hand.padding - goals.clearances)


def make_hand_obstacle(hand: Capsules, config: HandAvoidanceConfig) -> Obstacle:
    """Return the person's hand, given in the base frame, as an obstacle for the planner."""
    reach = config.padding + hand.radii.max()
    ends = np.concatenate([hand.starts, hand.ends])
    lower, upper = ends.min(axis=0) - reach, ends.max(axis=0) + reach
    field = sample_distance_field(hand.compute_distances, lower, upper, _HAND_CELL)
    return Obstacle(field, IDENTITY, config.padding, config.weight, in_tail=True)


def make_initial_trajectory(start: Array, goal: Array, n_waypoints: int) -> Array:
    """Return the waypoints (w, d) on a cubic between two configurations (d,) at rest."""
    spline = CubicSpline([0.0, 1.0], np.stack([start, goal]), bc_type="clamped")
    return np.asarray(spline(np.linspace(0.0, 1.0, n_waypoints + 2)[1:-1]))


class Chomp:
    """Trajectory optimizer CHOMP for goal sets (Zucker et al., 2013), one step at a time.

    Args:
        cost: Obstacle cost of trajectories.
        start: (7,) configuration before the first waypoint (rad).
        limits: Lower and upper joint limits with padding, (7,) each (rad).
        config: Step size and termination.
        costs: Weights of obstacle and smoothness costs.
    """

    def __init__(
        self, cost: ObstacleCost, start: Array, limits: Limits, config: ChompConfig, costs: CostConfig
    ) -> None:
        self._cost, self._start, self._limits = cost, start, limits
        self._config, self._costs = config, costs
        count = config.n_waypoints
        difference = (np.eye(count) - np.eye(count, k=-1)) / costs.time_step
        self._metric = difference.T @ difference
        self._inverse_metric = np.linalg.inv(self._metric)
        # Smoothness is half the squared norm of the differences, the first of which has the start.
        self._start_gradient = difference.T @ np.concatenate([[-1.0 / costs.time_step], np.zeros(count - 1)])
        ends = self._inverse_metric[:, -cost.n_tail :]
        self._tail_correction = ends @ np.linalg.inv(ends[-cost.n_tail :])

    def compute_smoothness_cost(self, trajectory: Array) -> float:
        """Return half the sum of squared joint velocities of a trajectory (w, 7)."""
        steps = np.diff(trajectory, axis=0, prepend=self._start[None]) / self._costs.time_step
        return float(0.5 * (steps**2).sum())

    def compute_smoothness_gradient(self, trajectory: Array) -> Array:
        """Return the gradient (w, 7) of the smoothness cost of a trajectory (w, 7)."""
        return np.asarray(self._metric @ trajectory + self._start_gradient[:, None] * self._start)

    def step(self, trajectory: Array, tail: Array, number: int) -> Array:
        """Return the trajectory (w, 7) after a gradient step, numbered from 1, that ends on an approach (t, 7)."""
        smooth = self.compute_smoothness_gradient(trajectory)
        near = self._costs.obstacle_weight * self._cost.compute_gradient(trajectory, self._start, tail[-1])
        near = np.clip(near, -self._costs.max_gradient, self._costs.max_gradient)
        weight = self._costs.smoothness_weight * self._costs.smoothness_growth**number
        descent = self._config.step_size * (self._inverse_metric @ (near + weight * smooth))
        error = trajectory[-len(tail) :] - tail
        moved = trajectory - descent + self._tail_correction @ (descent[-len(tail) :] - error)
        return self._project_to_limits(moved)

    def compute_limit_violation(self, trajectory: Array) -> Array:
        """Return the joint changes (w, 7) in rad that bring a trajectory within joint limits."""
        low, high = self._limits
        return np.maximum(low - trajectory, 0.0) + np.minimum(high - trajectory, 0.0)

    def is_finished(self, trajectory: Array, goal: Array, collision_distance: float) -> bool:
        """Return whether the optimization of a trajectory (w, 7) to a grasp (7,) may end early.

        A body point nearer than `collision_distance` (m) to an obstacle collides.
        """
        config = self._config
        return (
            float(np.linalg.norm(trajectory[-1] - goal)) < config.goal_tolerance
            and self.compute_smoothness_cost(trajectory) < config.max_smoothness_cost
            and float(np.abs(self.compute_limit_violation(trajectory)).max()) <= config.max_limit_violation
            and self._cost.count_collisions(trajectory, collision_distance) <= config.max_collisions
        )

    def _project_to_limits(self, trajectory: Array) -> Array:
        """Return the trajectory smoothly moved towards the joint limits.

        The tail moves too; the next step repairs it.
        """
        for _ in range(self._config.max_limit_projections):
            violation = self.compute_limit_violation(trajectory)
            if np.linalg.norm(violation) <= self._config.limit_tolerance:
                break
            smooth = self._inverse_metric @ violation
            worst = np.unravel_index(np.abs(violation).argmax(), violation.shape)
            scale = abs(violation[worst]) / max(abs(smooth[worst]), np.finfo(np.float64).tiny)
            trajectory = trajectory + scale * smooth
        return trajectory
