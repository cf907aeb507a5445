"""Expert for imitation learning: selection of the grasp to approach, and a plan to reach it.

Candidates are the cheapest grasps that the arm reaches both by full inverse kinematics and by the
receiver's own stepwise control, which stalls near singular postures. The planner `omg` (Wang et
al., RSS 2020) chooses among the best ones and plans a trajectory of waypoints 0.15 s apart.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, TABLE_HEIGHT
from handover_marl.geometry.distance_field import load_object_sdf
from handover_marl.geometry.panda import OPEN, PAD_DISTANCE
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.learning.grasp_costs import load_validated_grasps
from handover_marl.learning.imitation.gaddpg.scenarios import ImitationScenario
from handover_marl.learning.networks.approach_field import compute_approach_steps
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.ik_solvers import make_ik_stepper
from handover_marl.planning.planner import OBJECT_PADDING, Planner, PlannerConfig
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances, compute_gripper_corners
from handover_marl.planning.trajectory_cost import Obstacle
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.reactive.grasps import compute_grasp_distances

Array = npt.NDArray[np.float64]

# Share of the way to its target that a joint covers in one decision: 150 steps with gain 0.01.
_SETTLED_FRACTION = 1.0 - 0.99**150
#: Number of decisions that should be left when the expert reaches a grasp: all, so that it is as fast as possible.
EXPERT_SPARE_STEPS = 20
_PLANNER = PlannerConfig(n_waypoints=20)
# Number of grasps, the cheapest reachable ones, whose approach is simulated, and of those among which the planner
# chooses.
_N_CANDIDATES, _PLANNER_GOALS = 24, 4
# Largest number of decisions of a simulated approach.
_MAX_DECISIONS = 20
# Distance of the middle between the pads from the grasp at which a simulated approach ends (m), and weight of the
# rotation in this distance (m/rad).
_TOLERANCE, _ROTATION_WEIGHT = 0.015, 0.05
# Cost per metre of distance from the grasp beyond the tolerance at the end of the simulated approach.
_MISS_COST = 20.0
# Distance from the cheapest grasp at the end of its simulated approach above which the scenario gets no plan (m).
_MAX_MISS = 0.03
# Cost of each decision of the simulated approach (m).
_DECISION_COST = 0.02
# Largest difference between a goal's cost and the cheapest goal's cost (m).
_MAX_EXCESS_COST = 0.15
# Cost by which another goal must be cheaper to replace the planner's goal (m).
_SWITCH_MARGIN = 0.03
# Distance of the standoff pose from the grasp (m), which the arm must reach too, and the largest difference of a joint
# between standoff pose and grasp (rad).
_STANDOFF, _MAX_JOINT_CHANGE = 0.06, 0.8
# Cost of a rotation of the hand relative to that of the travel of the middle between the pads (m/rad).
_ROTATION_COST = 0.15
# Factor that converts costs of loose grasps, as for the receiver `reactive`, from seconds to metres (m/s).
_PACE = 0.1
# Clearance of the gripper to the occluding sphere below which grasps cost more (m), at the grasp and on the straight
# approach of a given length (m), and the cost per metre below it.
_CLEARANCE, _SWEEP, _CLEARANCE_COST = 0.01, 0.08, 20.0
# Clearance of the gripper to the table below which a grasp has an additional cost (m), and this cost (m).
_TABLE_CLEARANCE, _TABLE_COST = 0.005, 3.0


class ExpertPlan(NamedTuple):
    """Plan of the expert: goal grasps (none if none is reachable) and a trajectory to the first one.

    Attributes:
        goals: (g, 7) world poses of the hand link, quaternions xyzw, the planner's goal first.
        costs: (g,) costs of the goals minus the smallest cost (m); distances from the present pose do not count.
        trajectory: (w, 7) arm joints at the waypoints of the planned motion to the first goal (rad).
    """

    goals: Array
    costs: Array
    trajectory: Array

    def choose_goal(self, hand: Array) -> Array:
        """Return the goal (7,) that is cheapest to reach from a world pose (7,), quaternion xyzw, of the hand link."""
        costs = self.costs + compute_grasp_distances(hand, self.goals, _ROTATION_COST, PAD_DISTANCE)
        costs[0] -= _SWITCH_MARGIN
        chosen: Array = self.goals[int(np.argmin(costs))]
        return chosen


_NO_PLAN = ExpertPlan(np.zeros((0, 7)), np.zeros(0), np.zeros((0, ARM_DOF)))


class GraspExpert:
    """Planner of the motions that the network of the receiver `gaddpg` imitates, and model of the arm that makes them.

    Args:
        context: Robot, and objects with their known grasps.

    Attributes:
        arm: Kinematics of the arm.

    Raises:
        SimulationError: The robot's model cannot be loaded.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._context, panda = context, context.panda
        self.arm = ArmInWorld.for_panda(context.panda_urdf, panda)
        self._stepper = make_ik_stepper(context.panda_urdf, panda)
        self._planner = Planner(context.panda_urdf, np.array(panda.start_joints[:ARM_DOF]), _PLANNER)

    def plan(self, scenario: ImitationScenario) -> ExpertPlan:
        """Return the expert's plan in a scenario; the plan has no goals if no grasp is reachable."""
        goals, costs = self._find_goals(scenario)
        if not len(goals):
            return _NO_PLAN
        reached = self._simulate_approach(scenario.joints, goals[0])[-1]
        if self._compute_miss(reached, goals[0]) > _MAX_MISS:
            return _NO_PLAN
        self._planner.set_start(scenario.joints)
        base_from_world = invert_pose(self.arm.base)
        sdf = load_object_sdf(self._context.find_object_urdf(scenario.object_name), OBJECT_PADDING)
        obstacle = Obstacle(sdf, compose(base_from_world, scenario.object_pose), OBJECT_PADDING)
        plan = self._planner.plan(compose(base_from_world, goals), [obstacle])
        if plan is None:
            return _NO_PLAN
        first = int(plan.goals.grasps[plan.chosen])
        order = np.array([first, *(number for number in range(len(goals)) if number != first)])
        return ExpertPlan(goals[order], costs[order] - costs.min(), plan.trajectory)

    def compute_step(self, hand: Array, goal: Array, remaining: int) -> Array:
        """Return the motion (6,) of the Panda's hand link that one decision commands towards a goal grasp.

        The motion is a translation (m) and extrinsic xyz Euler angles (rad) in the hand link's frame.

        Args:
            hand: (7,) present world pose of the hand link, quaternion xyzw.
            goal: (7,) world pose of the hand link at the grasp, quaternion xyzw.
            remaining: Number of remaining decisions.
        """
        step: Array = compute_approach_steps(hand[None], goal[None], np.array([remaining]), EXPERT_SPARE_STEPS)[0]
        return step

    def compute_next_joints(self, joints: Array, step: Array) -> Array:
        """Return the arm joints (7,) in rad 0.15 s after a decision of the receiver `gaddpg`; the motors lag behind.

        Args:
            joints: (7,) present arm joints (rad).
            step: (6,) commanded motion, as `compute_step` returns it.
        """
        rotation = Rotation.from_euler("xyz", step[3:]).as_quat()
        target = compose(self.arm.compute_hand_pose(joints), np.concatenate([step[:3], rotation]))
        solution = self._stepper.solve_step([*joints, OPEN, OPEN], target[:3], target[3:])[:ARM_DOF]
        return np.clip(joints + _SETTLED_FRACTION * (solution - joints), *self.arm.limits)

    def _find_goals(self, scenario: ImitationScenario) -> tuple[Array, Array]:
        """Return at most four reachable grasps of lowest cost, and their costs.

        Returns:
            (g, 7) world poses of the hand link, cheapest first if the distance from the present pose counts, and (g,)
            costs (m) that exclude this distance.
        """
        joints, names = scenario.joints, self._context.object_names
        (object_class,) = (number for number, name in names.items() if name == scenario.object_name)
        grasps = load_validated_grasps(self._context, object_class)
        if grasps is None:
            return np.zeros((0, 7)), np.zeros(0)
        world, hand = compose(scenario.object_pose, grasps[0]), self.arm.compute_hand_pose(joints)
        grasp_costs = _PACE * grasps[1] + compute_grasp_costs(world, hand, scenario.occluder)
        candidates = np.flatnonzero(self._are_reachable(world, joints))
        candidates = candidates[np.argsort(grasp_costs[candidates], kind="stable")][:_N_CANDIDATES]
        costs, best = np.full(len(world), np.inf), np.inf
        for number in candidates:
            # The cost of the approach is positive, so that more expensive grasps can be skipped.
            if grasp_costs[number] < best + _MAX_EXCESS_COST:
                costs[number] = grasp_costs[number] + self._compute_approach_cost(joints, world[number])
                best = min(best, costs[number])
        order = np.argsort(costs, kind="stable")[:_PLANNER_GOALS]
        order = order[costs[order] < best + _MAX_EXCESS_COST]
        return world[order], costs[order] - compute_grasp_distances(hand, world[order], _ROTATION_COST, PAD_DISTANCE)

    def _are_reachable(self, goals: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """Return whether the arm reaches n goals and their standoffs from joints (7,) in similar postures, (n,)."""
        standoffs = compose(goals, np.array([0.0, 0.0, -_STANDOFF, 0.0, 0.0, 0.0, 1.0]))
        before, standoff_found = self.arm.solve(standoffs, np.tile(joints, (len(goals), 1)), 30)
        after, goal_found = self.arm.solve(goals, before, 15)
        similar: npt.NDArray[np.bool_] = np.abs(after - before).max(axis=1) < _MAX_JOINT_CHANGE
        return standoff_found & goal_found & similar

    def _compute_approach_cost(self, joints: Array, goal: Array) -> float:
        """Return the cost (m) of the decisions and the final distance of a simulated approach from joints to a goal."""
        path = self._simulate_approach(joints, goal)
        return _DECISION_COST * len(path) + _MISS_COST * max(0.0, self._compute_miss(path[-1], goal) - _TOLERANCE)

    def _simulate_approach(self, joints: Array, goal: Array) -> list[Array]:
        """Simulate an approach from joints (7,) to a world pose (7,); return the joints before and after decisions."""
        path = [joints]
        for remaining in range(_MAX_DECISIONS, 0, -1):
            if self._compute_miss(path[-1], goal) < _TOLERANCE:
                break
            hand = self.arm.compute_hand_pose(path[-1])
            path.append(self.compute_next_joints(path[-1], self.compute_step(hand, goal, remaining)))
        return path

    def _compute_miss(self, joints: Array, goal: Array) -> float:
        """Return the distance (m), with the weighted rotation, of the hand link from a goal (7,) at arm joints (7,)."""
        hand = self.arm.compute_hand_pose(joints)
        return float(compute_grasp_distances(goal, hand[None], _ROTATION_WEIGHT, PAD_DISTANCE)[0])


def compute_grasp_costs(world: Array, hand: Array, occluder: Array) -> Array:
    """Return the costs (n,) in m of moving the hand link to n grasps, higher near the occluder or the table.

    Args:
        world: (n, 7) world poses of the hand link at the grasps, quaternions xyzw.
        hand: (7,) present world pose of the hand link, quaternion xyzw.
        occluder: (4,) world center and radius of the occluding sphere (m); radius 0 for none.
    """
    behind = compose(world, np.array([0.0, 0.0, -_SWEEP, 0.0, 0.0, 0.0, 1.0]))
    heights = np.minimum(*(compute_gripper_corners(poses)[..., 2].min(axis=1) for poses in (world, behind)))
    costs = compute_grasp_distances(hand, world, _ROTATION_COST, PAD_DISTANCE)
    costs += _TABLE_COST * (heights < TABLE_HEIGHT + _TABLE_CLEARANCE)
    if occluder[3] > 0.0:
        clearances = compute_grasp_clearances(world, Spheres(occluder[None, :3], occluder[3:]), _SWEEP)
        costs += _CLEARANCE_COST * np.maximum(0.0, _CLEARANCE - clearances)
    return costs
