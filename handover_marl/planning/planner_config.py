"""Configuration of the OMG planner; the defaults are the authors' values unless stated otherwise."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GoalConfig:
    """Configuration of how grasps become goal configurations.

    Attributes:
        ik_seeds: Arm configurations at which inverse kinematics starts (rad), in addition to the
            start of the trajectory.
        limit_padding: Amount by which joint limits are narrowed on each side (rad).
        max_iterations: Maximum number of Newton steps of inverse kinematics.
        tolerance: Maximum error of inverse kinematics in each component of position (m) and rotation vector (rad).
        standoff: Distance of the standoff pose from the grasp, back along the hand's z axis (m).
        n_tail: Number of poses on the approach (tail) from standoff to grasp, both included.
        max_tail_norm: Maximum norm of the joint differences on an approach (rad); on a longer one,
            inverse kinematics has jumped between arm configurations.
        max_rotation: Maximum rotation of the robot's hand relative to its start orientation, on the
            straight joint path to the grasp (rad).
        min_hand_x_z: Minimum z component, in the base frame, of the hand's unit x axis on the straight
            joint path to the grasp.
        n_path_checks: Number of points of the path at which the hand's orientation is checked.
        collision_distance: Distance below which a point of the robot collides with an object (m).
        max_collisions: Maximum number of colliding pairs of robot point and object at a standoff.
        min_goal_distance: Minimum distance between the standoffs of two goals (rad).
        max_goals: Maximum number of goals in a goal set.
    """

    ik_seeds: tuple[tuple[float, ...], ...] = (
        (2.5, 0.23, -2.89, -1.69, 0.056, 1.46, -1.27),
        (2.8, 0.23, -2.89, -1.69, 0.056, 1.46, -1.27),
        (2.0, 0.23, -2.89, -1.69, 0.056, 1.46, -1.27),
        (2.5, 0.83, -2.89, -1.69, 0.056, 1.46, -1.27),
        (0.049, 1.22, -1.87, -0.67, 2.12, 0.99, -0.85),
        (-2.28, -0.43, 2.47, -1.35, 0.62, 2.28, -0.27),
        (-2.02, -1.29, 2.20, -0.83, 0.22, 1.18, 0.74),
        (-2.2, 0.03, -2.89, -1.69, 0.056, 1.46, -1.27),
        (-2.5, -0.71, -2.73, -0.82, -0.7, 0.62, -0.56),
        (-2.0, -0.71, -2.73, -0.82, -0.7, 0.62, -0.56),
        (-2.66, -0.55, 2.06, -1.77, 0.96, 1.77, -1.35),
        (1.51, -1.48, -1.12, -1.55, -1.57, 1.15, 0.24),
    )
    limit_padding: float = 0.2
    max_iterations: int = 100
    tolerance: float = 1e-6
    standoff: float = 0.08
    n_tail: int = 5
    max_tail_norm: float = 2.0
    max_rotation: float = math.radians(120.0)
    min_hand_x_z: float = -0.3
    n_path_checks: int = 5
    collision_distance: float = 0.01
    max_collisions: int = 5
    min_goal_distance: float = 0.5
    max_goals: int = 100


@dataclass(frozen=True)
class CostConfig:
    """Configuration of the obstacle and smoothness costs of a trajectory.

    Attributes:
        time_step: Time between waypoints (s), which only scales velocities and accelerations.
        padding: Distance of a robot point from an object's surface below which it has a cost (m).
        obstacle_weight: Weight of the obstacle cost's gradient.
        smoothness_weight: Initial weight of the smoothness cost's gradient.
        smoothness_growth: Factor by which the smoothness weight grows in every optimization step.
        max_gradient: Largest absolute value of an entry of the weighted obstacle gradient; larger entries are clipped.
    """

    time_step: float = 0.1
    padding: float = 0.2
    obstacle_weight: float = 1.0
    smoothness_weight: float = 0.1
    smoothness_growth: float = 1.02
    max_gradient: float = 10.0


@dataclass(frozen=True)
class GoalSelectionConfig:
    """Configuration of online goal selection by mirror descent (Wang et al., 2020, III-C).

    Attributes:
        n_rounds: Number of selection rounds for which the optimal fixed learning rate is computed.
        learning_rates: Learning rates of the experts, as multiples of the optimal fixed rate.
        lookahead_rate: Number of waypoints by which the start of the evaluated straight path moves
            along the trajectory in each round.
        smoothness_weight: Weight of the straight path's squared length in joint space.
    """

    n_rounds: int = 50
    learning_rates: tuple[float, ...] = (0.25, 0.5, 1.0, 4.0, 16.0)
    lookahead_rate: float = 0.6
    smoothness_weight: float = 0.003


@dataclass(frozen=True)
class ChompConfig:
    """Configuration of the trajectory optimizer CHOMP for goal sets.

    Attributes:
        n_waypoints: Number of waypoints of a trajectory without its start.
        n_selection_steps: Number of optimization steps with goal selection.
        n_fixed_goal_steps: Number of further optimization steps with the last selected goal.
        step_size: Factor on the covariant gradient in each step.
        max_limit_projections: Maximum number of projections onto the joint limits in a step.
        limit_tolerance: Norm of joint limit violations below which no projection is made (rad).
        max_collisions: Maximum number of colliding pairs of body point and object in a trajectory
            that ends the optimization early.
        goal_tolerance: Maximum joint distance of the last waypoint from the goal in a trajectory
            that ends the optimization early (rad).
        max_smoothness_cost: Maximum smoothness cost of a trajectory that ends the optimization early.
        max_limit_violation: Maximum joint limit violation of a trajectory that ends the optimization early (rad).
    """

    n_waypoints: int = 30
    n_selection_steps: int = 50
    n_fixed_goal_steps: int = 20
    step_size: float = 0.1
    max_limit_projections: int = 10
    limit_tolerance: float = 1e-2
    max_collisions: int = 5
    goal_tolerance: float = 0.01
    max_smoothness_cost: float = 35.0
    max_limit_violation: float = 5e-3


@dataclass(frozen=True)
class HandAvoidanceConfig:
    """Configuration of the person's hand as an obstacle of the planner.

    Attributes:
        padding: Distance of a robot point from the person's hand below which it has a cost (m).
        weight: Weight of the hand's obstacle cost relative to the obstacle cost of an object.
        min_clearance: Minimum clearance of the gripper to the hand (m); goals with a smaller
            clearance are excluded if other goals exist.
        clearance_cost: Cost of a goal per metre by which its clearance is below `padding`.
    """

    padding: float = 0.1
    weight: float = 1.0
    min_clearance: float = 0.02
    clearance_cost: float = 10.0


@dataclass(frozen=True)
class PlannerConfig:
    """Configuration of the OMG planner (Wang et al., RSS 2020).

    Attributes:
        goals: Configuration of the goal set.
        costs: Configuration of the trajectory costs.
        selection: Configuration of goal selection.
        chomp: Configuration of the trajectory optimizer.
        hand: Configuration of hand avoidance, or None to ignore the hand, as the authors' code does.
        n_points_per_link: Number of collision points on each link of arm, hand and fingers.
        n_gripper_points: Number of points on the robot's hand and on each finger, from which
            clearances to the person's hand are computed.
        unchecked_last: Whether to reproduce an indexing error of the authors' code. It sets the costs of the last rows
            of any batch to zero, which is meant for the approach at the end of a trajectory. In a batch of goals these
            rows are the last five goals in the collision filter, and in goal selection the waypoints of the last goal,
            which makes that goal look cheap. Measured on DexYCB (exact physics, replay giver, paired by scene), the
            error changes s0 test (144 scenes) by +2.1 percentage points of success (95 %: -6.8 to +11.0) and -4.9 of
            contact (-12.6 to +3.0), s1 test (180 scenes) by +8.9 (+0.9 to +16.7) and -10.6 (-17.9 to -3.0).
    """

    goals: GoalConfig = GoalConfig()
    costs: CostConfig = CostConfig()
    selection: GoalSelectionConfig = GoalSelectionConfig()
    chomp: ChompConfig = ChompConfig()
    hand: HandAvoidanceConfig | None = None
    n_points_per_link: int = 15
    n_gripper_points: int = 60
    unchecked_last: bool = False
