"""Every constant of the planner, as the original sets it unless an attribute says otherwise."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GoalConfig:
    """How grasps become goals (m, rad).

    Attributes:
        anchors: Arm configurations from which inverse kinematics starts, beside the start of the motion.
        limit_padding: Joint limits are narrowed by so much on each side.
        iterations: Newton steps at most.
        tolerance: On each component of position and rotation vector.
        standoff: Distance of the first tail pose from the grasp, back along the hand's z axis.
        tail: Poses from standoff to grasp, both counted.
        longest_tail: Largest norm of a tail's joint differences; a longer one jumps between arm postures.
        largest_turn: How far the hand may turn from where it starts, on the way to the grasp.
        lowest_x: How far the hand's x axis may point down (z component) on the way.
        way_points: Where on the way these two are looked at.
        clearance: A body point nearer to an object than this collides.
        allowed_points: So many pairs of body point and object may collide.
        diversity: Least distance between the standoff configurations of two goals.
        most: Goals kept at most.
    """

    anchors: tuple[tuple[float, ...], ...] = (
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
    iterations: int = 100
    tolerance: float = 1e-6
    standoff: float = 0.08
    tail: int = 5
    longest_tail: float = 2.0
    largest_turn: float = math.radians(120.0)
    lowest_x: float = -0.3
    way_points: int = 5
    clearance: float = 0.01
    allowed_points: int = 5
    diversity: float = 0.5
    most: int = 100


@dataclass(frozen=True)
class CostConfig:
    """What a trajectory costs.

    Attributes:
        time_step: Between waypoints (s); it only scales derivatives.
        padding: Objects cost something up to this distance (m).
        obstacle_weight: Of the obstacle cost's gradient.
        smoothness_weight: Of the smoothness cost's gradient at first.
        smoothness_growth: Factor on it at every step.
        largest_gradient: Entries of the weighted obstacle gradient are clipped to this.
    """

    time_step: float = 0.1
    padding: float = 0.2
    obstacle_weight: float = 1.0
    smoothness_weight: float = 0.1
    smoothness_growth: float = 1.02
    largest_gradient: float = 10.0


@dataclass(frozen=True)
class SelectionConfig:
    """Online choice of the goal by mirror descent over experts (Wang et al., 2020, section III-C).

    Attributes:
        rounds: Steps that learning rates are made for, and during which the goal may change.
        rates: Experts' learning rates, as multiples of the best fixed one.
        pace: Waypoints by which the look-ahead starts later, for each step.
        smoothness: Weight of the straight way's squared length in joint space against its obstacle cost.
    """

    rounds: int = 50
    rates: tuple[float, ...] = (0.25, 0.5, 1.0, 4.0, 16.0)
    pace: float = 0.6
    smoothness: float = 0.003


@dataclass(frozen=True)
class OptimiserConfig:
    """Goal-set CHOMP.

    Attributes:
        waypoints: Of a trajectory, the start not counted.
        steps: Optimisation steps with choice of the goal.
        smooth_steps: Further ones with the goal fixed.
        step_size: Of the covariant gradient step.
        limit_steps: Projections onto the joint limits at most, in a step.
        limit_tolerance: Norm of the violations (rad) that needs no projection.
        allowed_points: So many pairs of body point and object may collide at the end.
        goal_distance: How near the last waypoint must come to the goal (rad).
        most_effort: Largest smoothness cost that may end the optimisation early.
        most_violation: Largest violation of a joint limit (rad) likewise.
    """

    waypoints: int = 30
    steps: int = 50
    smooth_steps: int = 20
    step_size: float = 0.1
    limit_steps: int = 10
    limit_tolerance: float = 1e-2
    allowed_points: int = 5
    goal_distance: float = 0.01
    most_effort: float = 35.0
    most_violation: float = 5e-3


@dataclass(frozen=True)
class HandAvoidance:
    """The person's hand as an obstacle, for who looks at it (m).

    Attributes:
        padding: The hand costs something up to this distance.
        weight: Of its cost against an object's.
        room: Goals whose gripper comes nearer to the hand than this are left out while others are there.
        rank: Price of each metre of room that a goal lacks, against its cost.
    """

    padding: float = 0.1
    weight: float = 1.0
    room: float = 0.02
    rank: float = 10.0


@dataclass(frozen=True)
class PlannerConfig:
    """All of it.

    Attributes:
        points_per_link: Body points on each of the arm's links, hand and fingers.
        gripper_points: Points on the hand and on each finger to measure the room beside the person's hand with.
        hand: How the person's hand counts, or None to ignore it as the original does.
        unchecked_last: The original blanks the costs of the last rows of whatever it evaluates together, meant for
            a trajectory's tail. Of a set of goals these are its last five in the collision filter, and the last
            one's nearest waypoints in the choice, which makes that goal look cheap. True does the same. Measured
            on DexYCB (exact physics, replay giver, paired by scene), it changes s0 test (144 scenes) by +2.1
            points of success (95 %: -6.8 to +11.0) and -4.9 of contact (-12.6 to +3.0), s1 test (180 scenes) by
            +8.9 (+0.9 to +16.7) and -10.6 (-17.9 to -3.0).
    """

    goals: GoalConfig = GoalConfig()
    costs: CostConfig = CostConfig()
    selection: SelectionConfig = SelectionConfig()
    optimiser: OptimiserConfig = OptimiserConfig()
    hand: HandAvoidance | None = None
    points_per_link: int = 15
    gripper_points: int = 60
    unchecked_last: bool = False
