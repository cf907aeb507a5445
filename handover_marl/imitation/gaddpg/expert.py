"""The expert: which grasp to go for from where the arm is, and a plan to it.

Candidates are the cheapest grasps from there whose poses the arm reaches, and that the receiver's own way of moving
gets to: one call of inverse kinematics a decision, which ends short of its target near singular postures. Between
these the planner `omg` decides (Wang et al., RSS 2020), and makes a trajectory of waypoints 0.15 s apart.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS
from handover_marl.imitation.gaddpg.grasp_book import GraspBook, way_prices
from handover_marl.imitation.gaddpg.kinematic_arm import KinematicArm
from handover_marl.imitation.gaddpg.situations import Situation
from handover_marl.models.poses import compose, inverse
from handover_marl.planning.approach import ApproachConfig, steps_to_goals
from handover_marl.planning.field_cache import object_field
from handover_marl.planning.obstacles import Obstacle
from handover_marl.planning.planner import Planner
from handover_marl.planning.planner_config import OptimiserConfig, PlannerConfig
from handover_marl.policies.context import PolicyContext

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ExpertConfig:
    """How goals are chosen (m, rad).

    Attributes:
        candidates: The cheapest grasps within reach, which are looked at closely.
        offered: So many of those that can be got to are left to the planner.
        decisions: In so many a goal is to be got to,
        near: so near: the pads' way, with a turn counted by
        arm: this (m/rad); what is left then costs
        missed: so many times its length, and where that is more than
        lost: this, there is no plan.
        decision: Price of every decision on the way (m).
        dearest: Goals that cost more than the cheapest by this are left out.
        kept: The planner's goal is kept on the way unless another is nearer by more than this.
        standoff: Where a grasp's last straight way begins; it must be within reach.
        longest_way: Joints change less than this on it (rad).
        approach: The way to a goal.
        planned: Whether the planner has the last word; else the cheapest goal is taken, and the receiver's own way.
        planner: The planner's constants.
    """

    candidates: int = 24
    offered: int = 4
    decisions: int = 20
    near: float = 0.015
    arm: float = 0.05
    missed: float = 20.0
    lost: float = 0.03
    decision: float = 0.02
    dearest: float = 0.15
    kept: float = 0.03
    standoff: float = 0.06
    longest_way: float = 0.8
    approach: ApproachConfig = field(default_factory=ApproachConfig)
    planned: bool = True
    planner: PlannerConfig = field(default_factory=lambda: PlannerConfig(optimiser=OptimiserConfig(waypoints=20)))


@dataclass(frozen=True, eq=False)
class ExpertPlan:
    """What the expert would do.

    Attributes:
        goals: (g, 7) world poses of the hand link to go to, the planner's first.
        prices: (g,) what each costs beside its way (m).
        path: (w, 7) the planner's joints (rad).
    """

    goals: Array
    prices: Array
    path: Array

    def goal(self, hand: Array, config: ExpertConfig, pads: float = 0.1, turn: float = 0.15) -> Array:
        """(7,) the goal to go to from a pose (7,) of the hand."""
        costs = self.prices + way_prices(hand, self.goals, pads, turn)
        costs[0] -= config.kept
        chosen: Array = self.goals[int(np.argmin(costs))]
        return chosen


class Expert:
    """Plans.

    Args:
        context: The robot and its objects.
        book: Grasps.
        arm: How decisions move the arm.
        config: How goals are chosen.
    """

    def __init__(self, context: PolicyContext, book: GraspBook, arm: KinematicArm, config: ExpertConfig) -> None:
        self._context, self._book, self._arm, self._config = context, book, arm, config
        panda = context.panda
        self._world_from_base = np.array([*panda.base_position, *panda.base_orientation])
        start = np.array(panda.start_joints[:ARM_JOINTS])
        self._planner = Planner(context.panda_urdf, start, config.planner)

    def plan(self, situation: Situation) -> ExpertPlan | None:
        """A plan, or None if there is no grasp that can be got to."""
        goals, prices = self.goals(situation.object_name, situation.pose, situation.joints, situation.ball)
        if not len(goals):
            return None
        own = self._way(situation.joints, goals[0])
        if self.left(self._arm.arm.hand(own[-1]), goals[0]) > self._config.lost:
            return None
        if not self._config.planned:
            return ExpertPlan(goals, prices - prices.min(), np.array(own))
        self._planner.start_from(situation.joints)
        base_from_world = inverse(self._world_from_base)
        padding = self._config.planner.costs.padding
        shape = object_field(self._context.object_urdf(situation.object_name), padding)
        obstacle = Obstacle(shape, compose(base_from_world, situation.pose), padding)
        found = self._planner.plan(compose(base_from_world, goals), [obstacle])
        if found is None:
            return None
        first = int(found.goals.grasps[found.chosen])
        order = np.array([first, *(number for number in range(len(goals)) if number != first)])
        return ExpertPlan(goals[order], prices[order] - prices.min(), found.trajectory)

    def goals(self, object_name: str, pose: Array, joints: Array, ball: Array) -> tuple[Array, Array]:
        """(g, 7) world poses of the hand link to go to, cheapest first, and (g,) prices without their ways (m).

        Args:
            object_name: Class of the object.
            pose: (7,) where it is.
            joints: (7,) where the arm is (rad).
            ball: (4,) middle and radius of what hides it.
        """
        config, grasps = self._config, self._book.of(object_name)
        if grasps is None:
            return np.zeros((0, 7)), np.zeros(0)
        world = compose(pose, grasps.poses)
        hand = self._arm.arm.hand(joints)
        prices = self._book.prices(grasps, world, hand, ball)
        numbers = np.flatnonzero(self._reached(world, joints))
        numbers = numbers[np.argsort(prices[numbers], kind="stable")][: config.candidates]
        costs = np.full(len(world), np.inf)
        best = np.inf
        for number in numbers:
            # Ways cost something, so that what is dearer already cannot be among the cheapest.
            if prices[number] < best + config.dearest:
                costs[number] = prices[number] + self._way_price(joints, world[number])
                best = min(best, costs[number])
        order = np.argsort(costs, kind="stable")[: config.offered]
        order = order[costs[order] < best + config.dearest]
        return world[order], costs[order] - way_prices(hand, world[order], 0.1, 0.15)

    def step(self, hand: Array, goal: Array, remaining: int) -> Array:
        """(6,) the step of one decision from a pose (7,) of the hand to a goal (7,), so many decisions being left."""
        found: Array = steps_to_goals(hand[None], goal[None], np.array([remaining]), self._config.approach)[0]
        return found

    def _reached(self, goals: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """(n,) whether the arm reaches goals (n, 7) and their standoffs, near to each other."""
        back = compose(goals, np.array([0.0, 0.0, -self._config.standoff, 0.0, 0.0, 0.0, 1.0]))
        before, found = self._arm.arm.solve(back, np.tile(joints, (len(goals), 1)), 30)
        there, straight = self._arm.arm.solve(goals, before, 15)
        near: npt.NDArray[np.bool_] = np.abs(there - before).max(axis=1) < self._config.longest_way
        return found & straight & near

    def _way_price(self, joints: Array, goal: Array) -> float:
        """Price of the way to a goal as the receiver moves, with what is left of it when the time is up."""
        way = self._way(joints, goal)
        left = max(0.0, self.left(self._arm.arm.hand(way[-1]), goal) - self._config.near)
        return self._config.decision * len(way) + self._config.missed * left

    def _way(self, joints: Array, goal: Array) -> list[Array]:
        """Joints (7,) on the way to a goal as the receiver moves, one a decision, until it is near."""
        config, way = self._config, [joints]
        for remaining in range(config.decisions, 0, -1):
            hand = self._arm.arm.hand(way[-1])
            if self.left(hand, goal) < config.near:
                break
            way.append(self._arm.moved(way[-1], self.step(hand, goal, remaining)))
        return way

    def left(self, hand: Array, goal: Array) -> float:
        """How far a hand (7,) is from a goal (7,): the pads' way, with the turn counted (m)."""
        relative = compose(inverse(goal), hand)
        turn = Rotation.from_quat(relative[3:])
        pads = relative[:3] + 0.1 * (turn.as_matrix()[:, 2] - np.array([0.0, 0.0, 1.0]))
        return float(np.linalg.norm(pads) + self._config.arm * turn.magnitude())
