"""Configuration of the OMG planner; the defaults are the authors' values unless stated otherwise."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CostConfig:
    """Configuration of the obstacle cost of a trajectory.

    Attributes:
        padding: Distance of a robot point from an object's surface below which it has a cost (m).
    """

    padding: float = 0.2


@dataclass(frozen=True)
class ChompConfig:
    """Configuration of the trajectory optimizer CHOMP for goal sets.

    Attributes:
        n_waypoints: Number of waypoints of a trajectory without its start.
    """

    n_waypoints: int = 30


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
        costs: Configuration of the trajectory costs.
        chomp: Configuration of the trajectory optimizer.
        hand: Configuration of hand avoidance, or None to ignore the hand, as the authors' code does.
        unchecked_last: Whether to reproduce an indexing error of the authors' code. It sets the costs of the last rows
            of any batch to zero, which is meant for the approach at the end of a trajectory. In a batch of goals these
            rows are the last five goals in the collision filter, and in goal selection the waypoints of the last goal,
            which makes that goal look cheap. Measured on DexYCB (exact physics, replay giver, paired by scene), the
            error changes s0 test (144 scenes) by +2.1 percentage points of success (95 %: -6.8 to +11.0) and -4.9 of
            contact (-12.6 to +3.0), s1 test (180 scenes) by +8.9 (+0.9 to +16.7) and -10.6 (-17.9 to -3.0).
    """

    costs: CostConfig = CostConfig()
    chomp: ChompConfig = ChompConfig()
    hand: HandAvoidanceConfig | None = None
    unchecked_last: bool = False
