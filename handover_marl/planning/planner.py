"""Manipulation trajectory optimisation with online grasp selection (Wang et al., RSS 2020)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.models.arm import Arm
from handover_marl.models.distance_field import field_of
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK, LOWER_LIMITS, UPPER_LIMITS
from handover_marl.models.poses import IDENTITY
from handover_marl.planning.body_samples import body_samples
from handover_marl.planning.capsules import Capsules
from handover_marl.planning.chomp import Chomp, first_trajectory
from handover_marl.planning.goal_selection import GoalSelector
from handover_marl.planning.goal_set import GoalFinder, GoalSet
from handover_marl.planning.obstacles import Obstacle
from handover_marl.planning.planner_config import HandAvoidance, PlannerConfig
from handover_marl.planning.trajectory_cost import BodyCost

Array = npt.NDArray[np.float64]

_HAND_CELL = 0.01  # m


@dataclass(frozen=True, eq=False)
class Plan:
    """What was planned, in the robot's base frame.

    Attributes:
        start: (7,) joints at the start (rad).
        goals: What the arm might have ended at.
        chosen: Number of the goal it ends at.
        trajectory: (w, 7) joints (rad), the start not counted; the last rows are the goal's tail.
        steps: Optimisation steps taken.
    """

    start: Array
    goals: GoalSet
    chosen: int
    trajectory: Array
    steps: int


class Planner:
    """Plans from one start to a grasp.

    Args:
        panda_urdf: The robot's model.
        start: (7,) joints at which motions start (rad).
        config: Constants.

    Raises:
        SimulationError, DataFormatError: The model is no Panda, or a mesh cannot be read.
    """

    def __init__(self, panda_urdf: Path, start: Array, config: PlannerConfig) -> None:
        self.config = config
        self.arm = Arm(read_tree(panda_urdf))
        self._start = start
        padding = config.goals.limit_padding
        joints = self.arm.n_joints
        self._limits = (
            np.array(LOWER_LIMITS[:joints]) + padding,
            np.array(UPPER_LIMITS[:joints]) - padding,
        )
        self._body = body_samples(panda_urdf, tuple(self.arm.link_names), config.points_per_link)
        self._gripper = body_samples(panda_urdf, (HAND_LINK, *FINGER_LINKS), config.gripper_points)
        self._finder = self._finder_from(start)

    def start_from(self, start: Array) -> None:
        """Let motions start at (7,) other joints (rad) from now on."""
        self._start, self._finder = start, self._finder_from(start)

    def _finder_from(self, start: Array) -> GoalFinder:
        return GoalFinder(self.arm, self._body, self._gripper, start, self._limits, self.config)

    def plan(self, grasps: Array, objects: Sequence[Obstacle], hand: Capsules | None = None) -> Plan | None:
        """A trajectory to one of some grasps.

        Args:
            grasps: (n, 7) poses of the hand link in the base frame.
            objects: Where the objects are.
            hand: The person's hand in the base frame, if it is to be looked at.

        Returns:
            None if no grasp can be reached.
        """
        config = self.config
        person = None if hand is None or config.hand is None else hand_obstacle(hand, config.hand)
        goals = self._finder.find(grasps, objects, person)
        if not len(goals):
            return None
        obstacles = [*objects] if person is None else [*objects, person]
        body = BodyCost(self.arm, self._body, obstacles, config.goals.tail, config.costs)
        chomp = Chomp(body, self._start, self._limits, config.optimiser, config.costs)
        selector = GoalSelector(
            body,
            goals.goals,
            self._handicaps(goals),
            config.optimiser.waypoints,
            config.selection,
            config.unchecked_last,
        )
        return self._optimise(goals, selector, chomp)

    def _optimise(self, goals: GoalSet, selector: GoalSelector, chomp: Chomp) -> Plan:
        config = self.config.optimiser
        first = first_trajectory(self._start, goals.goals[0], config.waypoints)
        chosen = selector.first(first)
        trajectory = first_trajectory(self._start, goals.goals[chosen], config.waypoints)
        for step in range(config.steps + config.smooth_steps):
            if step < config.steps:
                chosen = selector.next(trajectory, step + 1)
            if step > 0 and chomp.done(trajectory, goals.goals[chosen], self.config.goals.clearance):
                return Plan(self._start, goals, chosen, trajectory, step)
            trajectory = chomp.step(trajectory, goals.tails[chosen], step + 1)
        return Plan(self._start, goals, chosen, trajectory, config.steps + config.smooth_steps)

    def _handicaps(self, goals: GoalSet) -> Array:
        """(g,) what goals cost for lack of room beside the person's hand."""
        if self.config.hand is None:
            return np.zeros(len(goals))
        return self.config.hand.rank * np.maximum(0.0, self.config.hand.padding - goals.rooms)


def hand_obstacle(hand: Capsules, config: HandAvoidance) -> Obstacle:
    """A hand in the base frame as something to keep clear of."""
    reach = config.padding + hand.radii.max()
    ends = np.concatenate([hand.starts, hand.ends])
    field = field_of(hand.distances, ends.min(axis=0) - reach, ends.max(axis=0) + reach, _HAND_CELL)
    return Obstacle(field, IDENTITY, config.padding, config.weight, in_tail=True)
