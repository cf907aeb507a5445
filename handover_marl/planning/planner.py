"""OMG: manipulation trajectory optimization with online grasp selection (Wang et al., RSS 2020).

The optimizer is goal-set CHOMP (Zucker et al., 2013): covariant gradient steps that keep the end of a trajectory on the
approach of a goal, the straight path to its grasp (Wang et al., 2020, section III-B).
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
from handover_marl.planning.goal_set import COLLISION_DISTANCE, N_APPROACH, GoalSelector, GoalSet, GoalSetBuilder
from handover_marl.planning.hand_tracker import Capsules
from handover_marl.planning.trajectory_cost import WAYPOINT_PERIOD, Obstacle, ObstacleCost, sample_body_points

Array = npt.NDArray[np.float64]

#: Distance from an object's surface (m) up to which a point of the robot has a cost.
OBJECT_PADDING = 0.2
# Distance from the person's hand (m) up to which a point of the robot has a cost, cost of a goal per meter by which its
# clearance is below this distance, and cell size of the hand's distance field (m).
_HAND_PADDING, _CLEARANCE_COST, _HAND_CELL = 0.1, 10.0, 0.01

# Values of the authors unless stated otherwise.
# Amount by which joint limits are narrowed on each side (rad).
_LIMIT_PADDING = 0.2
# Number of collision points on each link, and of points on the robot's hand and on each finger from which clearances
# to the person's hand are computed (own value).
_N_POINTS_PER_LINK, _N_GRIPPER_POINTS = 15, 60
# Number of optimization steps with goal selection, and of further ones with the last selected goal.
_N_SELECTION_STEPS, _N_FIXED_GOAL_STEPS = 50, 20
# Weight of the obstacle cost's gradient, and largest absolute value of an entry of the weighted gradient.
_OBSTACLE_WEIGHT, _MAX_GRADIENT = 1.0, 10.0
# Initial weight of the smoothness cost's gradient, and factor by which it grows in every optimization step.
_SMOOTHNESS_WEIGHT, _SMOOTHNESS_GROWTH = 0.1, 1.02
# Factor on the covariant gradient in each step.
_STEP_SIZE = 0.1
# Number of projections onto the joint limits in a step, and norm of violations below which none is made (rad).
_MAX_LIMIT_PROJECTIONS, _LIMIT_TOLERANCE = 10, 1e-2
# The optimization ends early once the trajectory has at most this number of colliding pairs of body point and object,
# joint distance of the last waypoint from the goal (rad), smoothness cost and joint limit violation (rad).
_MAX_COLLISIONS, _GOAL_TOLERANCE, _MAX_SMOOTHNESS_COST, _MAX_LIMIT_VIOLATION = 5, 0.01, 35.0, 5e-3


@dataclass(frozen=True)
class PlannerConfig:
    """Configuration of the OMG planner (Wang et al., RSS 2020).

    Attributes:
        n_waypoints: Number of waypoints of a trajectory without its start; the default is the authors'.
        avoids_hand: Whether the person's hand is an obstacle; the authors' code ignores it.
        unchecked_last: Whether to reproduce an indexing error of the authors' code. Their code sets the obstacle costs
            in the last rows of an array to zero, as if these rows were the approach of a trajectory. In the collision
            check, rows are goals: the last five always pass. In goal selection, the last rows belong to the path to the
            last goal: only this goal has a free approach and seems cheap. Measured on DexYCB (exact physics, replay
            giver, paired by scene), the error changes the rates of success and of contact by +2.1 percentage points
            (95 %: -6.8 to +11.0) and -4.9 (-12.6 to +3.0) on s0 test (144 scenes), by +8.9 (+0.9 to +16.7) and -10.6
            (-17.9 to -3.0) on s1 test (180 scenes).
    """

    n_waypoints: int = 30
    avoids_hand: bool = False
    unchecked_last: bool = False


@dataclass(frozen=True, eq=False)
class Plan:
    """Planned trajectory of the arm to a grasp.

    Attributes:
        start: (7,) configuration before the first waypoint (rad).
        goals: Goal set from which the goal of the trajectory was selected.
        goal_index: Index of the selected goal in `goals`.
        trajectory: (w, 7) waypoints (rad); the last five are the approach from standoff to grasp.
        steps: Number of optimization steps that were made.
    """

    start: Array
    goals: GoalSet
    goal_index: int
    trajectory: Array
    steps: int


class Planner:
    """OMG planner of arm trajectories from one start configuration to a grasp.

    Args:
        panda_urdf: URDF model of the robot.
        start: (7,) configuration at which planned trajectories start (rad).
        config: Configuration of the planner.

    Attributes:
        arm: Kinematics of the arm in its base frame.
    """

    def __init__(self, panda_urdf: Path, start: Array, config: PlannerConfig) -> None:
        self.config = config
        self.arm = ArmKinematics(read_tree(panda_urdf))
        joints = self.arm.n_joints
        self._limits = (
            np.array(LOWER_LIMITS[:joints]) + _LIMIT_PADDING,
            np.array(UPPER_LIMITS[:joints]) - _LIMIT_PADDING,
        )
        self._body = sample_body_points(panda_urdf, tuple(self.arm.link_names), _N_POINTS_PER_LINK)
        self._gripper = sample_body_points(panda_urdf, (HAND_LINK, *FINGER_LINKS), _N_GRIPPER_POINTS)
        self._start = start

    def set_start(self, start: Array) -> None:
        """Set the configuration (7,) in rad at which planned trajectories start."""
        self._start = start

    def plan(self, grasps: Array, objects: Sequence[Obstacle], hand: Capsules | None = None) -> Plan | None:
        """Compute a trajectory to one of the grasps, which are hand link poses (n, 7; quaternion xyzw).

        Grasps, obstacles `objects` and the person's `hand` are in the robot's base frame. The hand is ignored if it is
        None or `config.avoids_hand` is false. Returns None if no grasp passes the checks of `GoalSetBuilder.build`. A
        trajectory whose optimization has not converged is returned, too.
        """
        config = self.config
        person = make_hand_obstacle(hand) if hand is not None and config.avoids_hand else None
        robot = self.arm, self._body, self._gripper
        builder = GoalSetBuilder(*robot, self._start, self._limits, config.unchecked_last)
        goals = builder.build(grasps, objects, person)
        if not len(goals):
            return None
        obstacles = [*objects] if person is None else [*objects, person]
        cost = ObstacleCost(self.arm, self._body, obstacles, N_APPROACH)
        # Missing clearance to the person's hand has a cost; without a hand, clearances are infinite.
        goal_costs = _CLEARANCE_COST * np.maximum(0.0, _HAND_PADDING - goals.clearances)
        chomp = Chomp(cost, self._start, self._limits, config.n_waypoints)
        selector = GoalSelector(cost, goals.goals, goal_costs, config.n_waypoints, config.unchecked_last)
        return self._optimize(goals, selector, chomp)

    def _optimize(self, goals: GoalSet, selector: GoalSelector, chomp: "Chomp") -> Plan:
        """Compute a plan by up to 50 steps of goal selection and CHOMP, then up to 20 with the last selected goal."""
        n_waypoints = self.config.n_waypoints
        first = make_initial_trajectory(self._start, goals.goals[0], n_waypoints)
        goal_index = selector.select_first(first)
        trajectory = make_initial_trajectory(self._start, goals.goals[goal_index], n_waypoints)
        max_steps = _N_SELECTION_STEPS + _N_FIXED_GOAL_STEPS
        for step in range(max_steps):
            if step < _N_SELECTION_STEPS:
                goal_index = selector.select_next(trajectory, step + 1)
            goal = goals.goals[goal_index]
            if step > 0 and chomp.is_finished(trajectory, goal):
                return Plan(self._start, goals, goal_index, trajectory, step)
            trajectory = chomp.step(trajectory, goals.approaches[goal_index], step + 1)
        return Plan(self._start, goals, goal_index, trajectory, max_steps)


def make_hand_obstacle(hand: Capsules) -> Obstacle:
    """Return the person's hand, given in the robot's base frame, as an obstacle for the planner."""
    reach = _HAND_PADDING + hand.radii.max()
    ends = np.concatenate([hand.starts, hand.ends])
    lower, upper = ends.min(axis=0) - reach, ends.max(axis=0) + reach
    field = sample_distance_field(hand.compute_distances, lower, upper, _HAND_CELL)
    return Obstacle(field, IDENTITY, _HAND_PADDING, active_in_approach=True)


def make_initial_trajectory(start: Array, goal: Array, n_waypoints: int) -> Array:
    """Return waypoints (w, d) on a cubic path, at rest at both ends, between two configurations (d,), without these."""
    spline = CubicSpline([0.0, 1.0], np.stack([start, goal]), bc_type="clamped")
    return np.asarray(spline(np.linspace(0.0, 1.0, n_waypoints + 2)[1:-1]))


class Chomp:
    """Trajectory optimizer CHOMP for goal sets (Zucker et al., 2013), one step at a time.

    Args:
        cost: Obstacle cost of trajectories.
        start: (7,) configuration before the first waypoint (rad).
        limits: Lower and upper joint limits with padding, (7,) each (rad).
        n_waypoints: Number of waypoints of a trajectory.
    """

    def __init__(self, cost: ObstacleCost, start: Array, limits: tuple[Array, Array], n_waypoints: int) -> None:
        self._cost, self._start, self._limits = cost, start, limits
        difference = (np.eye(n_waypoints) - np.eye(n_waypoints, k=-1)) / WAYPOINT_PERIOD
        self._metric = difference.T @ difference
        self._inverse_metric = np.linalg.inv(self._metric)
        # Smoothness is half the squared norm of the differences, the first of which is from the start.
        self._start_gradient = difference.T @ np.concatenate([[-1.0 / WAYPOINT_PERIOD], np.zeros(n_waypoints - 1)])
        ends = self._inverse_metric[:, -cost.n_approach :]
        self._approach_correction = ends @ np.linalg.inv(ends[-cost.n_approach :])

    def compute_smoothness_cost(self, trajectory: Array) -> float:
        """Return half the sum of the squared joint velocities (rad/s) of a trajectory (w, 7) in rad."""
        steps = np.diff(trajectory, axis=0, prepend=self._start[None]) / WAYPOINT_PERIOD
        return float(0.5 * (steps**2).sum())

    def step(self, trajectory: Array, approach: Array, number: int) -> Array:
        """Return a trajectory (w, 7) after gradient step `number` (from 1), its end moved to `approach` (t, 7)."""
        smooth = self._metric @ trajectory + self._start_gradient[:, None] * self._start
        near = _OBSTACLE_WEIGHT * self._cost.compute_gradient(trajectory, self._start, approach[-1])
        near = np.clip(near, -_MAX_GRADIENT, _MAX_GRADIENT)
        weight = _SMOOTHNESS_WEIGHT * _SMOOTHNESS_GROWTH**number
        descent = _STEP_SIZE * (self._inverse_metric @ (near + weight * smooth))
        error = trajectory[-len(approach) :] - approach
        moved = trajectory - descent + self._approach_correction @ (descent[-len(approach) :] - error)
        return self._project_to_limits(moved)

    def compute_limit_violation(self, trajectory: Array) -> Array:
        """Return the joint changes (w, 7) in rad that bring a trajectory (w, 7) within the joint limits, 0 inside."""
        low, high = self._limits
        return np.maximum(low - trajectory, 0.0) + np.minimum(high - trajectory, 0.0)

    def is_finished(self, trajectory: Array, goal: Array) -> bool:
        """Return whether a trajectory (w, 7) to the configuration `goal` (7,) in rad needs no further optimization."""
        return (
            float(np.linalg.norm(trajectory[-1] - goal)) < _GOAL_TOLERANCE
            and self.compute_smoothness_cost(trajectory) < _MAX_SMOOTHNESS_COST
            and float(np.abs(self.compute_limit_violation(trajectory)).max()) <= _MAX_LIMIT_VIOLATION
            and self._cost.count_collisions(trajectory, COLLISION_DISTANCE) <= _MAX_COLLISIONS
        )

    def _project_to_limits(self, trajectory: Array) -> Array:
        """Return a trajectory (w, 7), waypoints of path and approach, moved smoothly to within the joint limits."""
        for _ in range(_MAX_LIMIT_PROJECTIONS):
            violation = self.compute_limit_violation(trajectory)
            if np.linalg.norm(violation) <= _LIMIT_TOLERANCE:
                break
            smooth = self._inverse_metric @ violation
            worst = np.unravel_index(np.abs(violation).argmax(), violation.shape)
            scale = abs(violation[worst]) / max(abs(smooth[worst]), np.finfo(np.float64).tiny)
            trajectory = trajectory + scale * smooth
        return trajectory
