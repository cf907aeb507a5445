"""Random scenarios for imitation rollouts, and an expert that plans in them.

In a scenario, an object is at rest at a pose from a training scene (at the handover, on the way there, or on the table)
with a random offset. The arm is at its start pose or observes the object from a random pose. An invisible sphere in
place of a person's hand occludes some objects partly; grasps keep clear of the sphere.

The expert considers the cheapest grasps that the arm reaches both by inverse kinematics with many iterations and by the
stepwise control of the receiver `gaddpg`, which stalls near singular postures. The planner `omg` (Wang et al., RSS
2020) chooses among the best ones and plans a trajectory with one waypoint per decision (0.15 s).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, TABLE_HEIGHT, PandaConfig
from handover_marl.datasets import Dataset
from handover_marl.geometry.distance_field import load_object_sdf
from handover_marl.geometry.panda import OPEN, PAD_DISTANCE
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.geometry.rotations import quaternions_from_euler
from handover_marl.grasps.selector import load_validated_grasps
from handover_marl.grasps.validation import compute_grasp_distances
from handover_marl.learning.networks.approach_field import compute_approach_steps
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.ik_solvers import make_ik_stepper
from handover_marl.planning.planner import OBJECT_PADDING, Planner, PlannerConfig
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances, compute_gripper_corners
from handover_marl.planning.trajectory_cost import Obstacle
from handover_marl.policies.policy import PolicyContext
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Array = npt.NDArray[np.float64]

# Distance from the initial position from which an object counts as moving (m).
_MOVED = 0.02
# Shares of scenarios with the object at the handover pose of a recording, and on the way there; in the others it is on
# the table.
_HANDOVER_POSE_SHARE, _ON_THE_WAY_SHARE = 0.65, 0.15
# Standard deviations of the random displacement along each axis (m) and rotation about each axis (rad) of an object at
# the handover pose or on the way there.
_POSITION_STD, _ROTATION_STD = 0.04, 0.2
# Largest random displacement of an object on the table along x and y (m); its rotation about the vertical is random.
_TABLE_RANGE = 0.12
# Share of scenarios with the arm at its start pose, where half of them have noise with a standard deviation (rad) on
# every joint; in the others the arm observes the object from a random pose.
_START_POSE_SHARE, _JOINT_STD = 0.6, 0.04
# Smallest and largest distance of the robot's hand from the object at a random pose (m).
_MIN_DISTANCE, _MAX_DISTANCE = 0.2, 0.5
# Largest distance, along each axis, from the object's origin to the point at which the camera aims (m).
_AIM_ERROR = 0.05
# Share of scenarios in which a sphere occludes the object partly, and its smallest and largest radius (m).
_OCCLUDED_SHARE, _OCCLUDER_RADII = 0.5, (0.03, 0.07)
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
# Cost per meter of distance from the grasp beyond the tolerance at the end of the simulated approach.
_GOAL_ERROR_COST = 20.0
# Distance from the cheapest grasp at the end of its simulated approach above which the scenario gets no plan (m).
_MAX_GOAL_ERROR = 0.03
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
# Factor that converts costs of loose grasps, as for the receiver `reactive`, from seconds to meters (m/s).
_PACE = 0.1
# Clearance of the gripper to the occluding sphere below which grasps cost more (m), at the grasp and on the straight
# approach of a given length (m), and the cost per meter below it.
_CLEARANCE, _SWEEP, _CLEARANCE_COST = 0.01, 0.08, 20.0
# Clearance of the gripper to the table below which a grasp has an additional cost (m), and this cost (m).
_TABLE_CLEARANCE, _TABLE_COST = 0.005, 3.0


@dataclass(frozen=True, eq=False)
class ImitationScenario:
    """Initial state of an imitation rollout: object, arm and occluding sphere.

    Attributes:
        object_name: YCB class name of the object.
        dof: (6,) float32 position xyz (m) and intrinsic XYZ Euler angles (rad) of the object in the world.
        joints: (7,) positions of the arm joints (rad).
        occluder: (4,) center in the world and radius of the occluding sphere (m); radius 0 for none.
    """

    object_name: str
    dof: npt.NDArray[np.float32]
    joints: Array
    occluder: Array

    @property
    def object_pose(self) -> Array:
        """World pose (7,) of the object, quaternion xyzw."""
        return np.concatenate([self.dof[:3], quaternions_from_euler(self.dof[3:])])


class ImitationScenarios:
    """Sampler of random initial states (object, arm, occluding sphere) of imitation rollouts: `ImitationScenario`s.

    Args:
        data: Dataset of the scenes.
        scenes: Numbers of the training scenes.
        arm: Kinematics of the robot's arm.
        panda: Base and start pose of the robot.
        seed: Seed of all scenarios.
    """

    def __init__(self, data: Dataset, scenes: Sequence[int], arm: ArmInWorld, panda: PandaConfig, seed: int) -> None:
        self._data, self._scenes, self._arm, self._seed = data, scenes, arm, seed
        self._start = np.array(panda.start_joints[:ARM_DOF])
        self._base = np.array(panda.base_position)

    def sample(self, number: int) -> ImitationScenario:
        """Return a random scenario; it depends only on the seed of the sampler and on `number`."""
        rng = np.random.default_rng((self._seed, number))
        scene = self._data.load_scene(self._scenes[int(rng.integers(len(self._scenes)))])
        dof = self._sample_object_pose(scene.object_dof[:, 0], rng)
        joints = self._sample_joints(dof[:3].astype(np.float64), rng)
        radius = rng.uniform(*_OCCLUDER_RADII) if rng.random() < _OCCLUDED_SHARE else 0.0
        # Off center, so that a part of the object stays visible.
        direction = rng.standard_normal(3)
        center = dof[:3] + direction / np.linalg.norm(direction) * rng.uniform(0.5, 1.5) * radius
        return ImitationScenario(scene.info.target_name, dof, joints, np.array([*center, radius]))

    def _sample_object_pose(self, path: npt.NDArray[np.float32], rng: np.random.Generator) -> npt.NDArray[np.float32]:
        kind = rng.random()
        if kind >= _HANDOVER_POSE_SHARE + _ON_THE_WAY_SHARE:  # on the table
            turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
            rotation = turn * Rotation.from_euler("XYZ", path[0, 3:])
            position = path[0, :3] + np.array([*rng.uniform(-_TABLE_RANGE, _TABLE_RANGE, 2), 0.0])
            return np.concatenate([position, rotation.as_euler("XYZ")]).astype(np.float32)
        dof = path[-1]
        if kind >= _HANDOVER_POSE_SHARE:
            moving = np.flatnonzero(np.linalg.norm(path[:, :3] - path[0, :3], axis=1) > _MOVED)
            dof = path[int(rng.choice(moving))] if len(moving) else dof
        rotation = Rotation.from_rotvec(rng.normal(0.0, _ROTATION_STD, 3)) * Rotation.from_euler("XYZ", dof[3:])
        position = dof[:3] + rng.normal(0.0, _POSITION_STD, 3)
        return np.concatenate([position, rotation.as_euler("XYZ")]).astype(np.float32)

    def _sample_joints(self, position: Array, rng: np.random.Generator) -> Array:
        if rng.random() >= _START_POSE_SHARE:
            low, high = self._arm.limits
            for _ in range(4):
                goal = self._sample_viewing_pose(position, rng)
                solutions, converged = self._arm.solve(goal[None], self._start[None], 60)
                if converged[0]:
                    return np.asarray(np.clip(solutions[0], low, high))
        return np.asarray(self._start + rng.normal(0.0, _JOINT_STD, ARM_DOF) * (rng.random() < 0.5))

    def _sample_viewing_pose(self, target: Array, rng: np.random.Generator) -> Array:
        """Return a random, nearly upright world pose (7,) of the hand link, whose camera aims near a position (3,)."""
        direction = rng.standard_normal(3)
        # In the half-space on the side of the robot's base whose normal points 11 degrees above the horizontal.
        to_base = self._base - target
        to_base[2] = 0.2 * np.linalg.norm(to_base[:2])
        if direction @ to_base < 0.0:
            direction -= 2.0 * (direction @ to_base) / (to_base @ to_base) * to_base
        distance = rng.uniform(_MIN_DISTANCE, _MAX_DISTANCE)
        position = target + direction / np.linalg.norm(direction) * distance
        z = target + rng.uniform(-_AIM_ERROR, _AIM_ERROR, 3) - position
        z /= np.linalg.norm(z)
        x = Rotation.from_quat(self._arm.compute_hand_pose(self._start)[3:]).as_matrix()[:, 0]
        x = x - (x @ z) * z
        x /= max(float(np.linalg.norm(x)), 1e-6)
        rotation = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
        rotation = rotation * Rotation.from_rotvec([0.0, 0.0, rng.normal(0.0, 0.3)])
        return np.concatenate([position, rotation.as_quat()])


def find_occluded_points(points: npt.NDArray[np.float32], hand: Array, occluder: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the points of a cloud that are inside a sphere or hidden behind it from the wrist camera.

    Points (n, 3) are in the hand link's frame (m), whose world pose (7,) is `hand`; `occluder` (4,) has the center in
    the world and the radius of the sphere (m); radius 0 occludes nothing.
    """
    camera = np.array(WRIST_CAMERA.position)
    center = inverse_transform_points(hand, occluder[None, :3])[0] - camera
    rays = points - camera
    lengths = np.maximum((rays**2).sum(axis=1), 1e-12)
    # Nearest point to the sphere's center on each segment from camera to point.
    share = np.clip(rays @ center / lengths, 0.0, 1.0)
    occluded: npt.NDArray[np.bool_] = np.linalg.norm(share[:, None] * rays - center, axis=1) < occluder[3]
    return occluded


class ExpertPlan(NamedTuple):
    """Plan of the expert: goal grasps and a trajectory to the first one; both are empty if planning fails.

    Attributes:
        goals: (g, 7) world poses of the hand link, quaternions xyzw, the planner's goal first.
        costs: (g,) costs of the goals minus the smallest cost (m); distances from the present pose do not count.
        trajectory: (w, 7) arm joints at the waypoints of the planned motion to the first goal (rad).
    """

    goals: Array
    costs: Array
    trajectory: Array

    def choose_goal(self, hand: Array) -> Array:
        """Return the goal (7,) of lowest cost from a world pose `hand` (7,), quaternion xyzw, of the hand link.

        The distance from `hand` adds to the costs. The planner's goal is replaced only if another is 0.03 m cheaper.
        """
        costs = self.costs + compute_grasp_distances(hand, self.goals, _ROTATION_COST, PAD_DISTANCE)
        costs[0] -= _SWITCH_MARGIN
        return np.asarray(self.goals[int(np.argmin(costs))])


_NO_PLAN = ExpertPlan(np.zeros((0, 7)), np.zeros(0), np.zeros((0, ARM_DOF)))


class GraspExpert:
    """Expert that the network of the receiver `gaddpg` imitates: planner of grasps and motions, and model of the arm.

    Args:
        context: Robot, and objects with their known grasps.

    Attributes:
        arm: Kinematics of the arm.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._context, panda = context, context.panda
        self.arm = ArmInWorld.for_panda(context.panda_urdf, panda)
        self._stepper = make_ik_stepper(context.panda_urdf, panda)
        self._planner = Planner(context.panda_urdf, np.array(panda.start_joints[:ARM_DOF]), _PLANNER)

    def plan(self, scenario: ImitationScenario) -> ExpertPlan:
        """Return the expert's plan in a scenario; it has no goals if no grasp is reachable or no path is found."""
        goals, costs = self._find_goals(scenario)
        if not len(goals):
            return _NO_PLAN
        reached = self._simulate_approach(scenario.joints, goals[0])[-1]
        if self._compute_goal_error(reached, goals[0]) > _MAX_GOAL_ERROR:
            return _NO_PLAN
        self._planner.set_start(scenario.joints)
        base_from_world = invert_pose(self.arm.base)
        sdf = load_object_sdf(self._context.find_object_urdf(scenario.object_name), OBJECT_PADDING)
        obstacle = Obstacle(sdf, compose(base_from_world, scenario.object_pose), OBJECT_PADDING)
        plan = self._planner.plan(compose(base_from_world, goals), [obstacle])
        if plan is None:
            return _NO_PLAN
        first = int(plan.goals.grasps[plan.goal_index])
        order = np.array([first, *(number for number in range(len(goals)) if number != first)])
        return ExpertPlan(goals[order], costs[order] - costs.min(), plan.trajectory)

    def compute_step(self, hand: Array, goal: Array, remaining: int) -> Array:
        """Return the motion (6,) of the Panda's hand link that one decision commands towards a goal grasp.

        It consists of a translation (m) and extrinsic xyz Euler angles (rad) in the hand link's frame.

        Args:
            hand: (7,) present world pose of the hand link, quaternion xyzw.
            goal: (7,) world pose of the hand link at the grasp, quaternion xyzw.
            remaining: Number of remaining decisions.
        """
        steps = compute_approach_steps(hand[None], goal[None], np.array([remaining]), EXPERT_SPARE_STEPS)
        return np.asarray(steps[0])

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
            (g, 7) world poses of the hand link, quaternions xyzw, cheapest first, and (g,) costs (m). The order
            includes the distance from the present pose, the costs do not.
        """
        joints, names = scenario.joints, self._context.object_names
        (object_class,) = (number for number, name in names.items() if name == scenario.object_name)
        grasps = load_validated_grasps(self._context, object_class)
        if grasps is None:
            return np.zeros((0, 7)), np.zeros(0)
        world, hand = compose(scenario.object_pose, grasps[0]), self.arm.compute_hand_pose(joints)
        grasp_costs = _PACE * grasps[1] + _compute_grasp_costs(world, hand, scenario.occluder)
        candidates = np.flatnonzero(self._are_reachable(world, joints))
        candidates = candidates[np.argsort(grasp_costs[candidates], kind="stable")][:_N_CANDIDATES]
        costs, best = np.full(len(world), np.inf), np.inf
        for number in candidates:
            # The cost of the approach is positive, so that more expensive grasps can be skipped.
            if grasp_costs[number] < best + _MAX_EXCESS_COST:
                path = self._simulate_approach(joints, world[number])
                excess = max(0.0, self._compute_goal_error(path[-1], world[number]) - _TOLERANCE)
                costs[number] = grasp_costs[number] + _DECISION_COST * len(path) + _GOAL_ERROR_COST * excess
                best = min(best, costs[number])
        order = np.argsort(costs, kind="stable")[:_PLANNER_GOALS]
        order = order[costs[order] < best + _MAX_EXCESS_COST]
        return world[order], costs[order] - compute_grasp_distances(hand, world[order], _ROTATION_COST, PAD_DISTANCE)

    def _are_reachable(self, goals: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """Return (n,) whether the arm, now at `joints` (7,), reaches goals (n, 7) and their standoff poses.

        The joints at a goal must be similar to those at its standoff pose.
        """
        standoffs = compose(goals, np.array([0.0, 0.0, -_STANDOFF, 0.0, 0.0, 0.0, 1.0]))
        before, standoff_found = self.arm.solve(standoffs, np.tile(joints, (len(goals), 1)), 30)
        after, goal_found = self.arm.solve(goals, before, 15)
        similar: npt.NDArray[np.bool_] = np.abs(after - before).max(axis=1) < _MAX_JOINT_CHANGE
        return standoff_found & goal_found & similar

    def _simulate_approach(self, joints: Array, goal: Array) -> list[Array]:
        """Simulate an approach from joints (7,) to a world pose (7,); return the joints before and after each step."""
        path = [joints]
        for remaining in range(_MAX_DECISIONS, 0, -1):
            if self._compute_goal_error(path[-1], goal) < _TOLERANCE:
                break
            hand = self.arm.compute_hand_pose(path[-1])
            path.append(self.compute_next_joints(path[-1], self.compute_step(hand, goal, remaining)))
        return path

    def _compute_goal_error(self, joints: Array, goal: Array) -> float:
        """Return the distance (m) of the hand at arm joints (7,) from a goal (7,), plus the weighted angle to it."""
        hand = self.arm.compute_hand_pose(joints)
        return float(compute_grasp_distances(goal, hand[None], _ROTATION_WEIGHT, PAD_DISTANCE)[0])


def _compute_grasp_costs(world: Array, hand: Array, occluder: Array) -> Array:
    """Return the costs (n,) in m of moving the hand link from a pose (7,) to n world poses (n, 7), quaternions xyzw.

    They are higher near the table, and near the occluding sphere: `occluder` (4,) has its world center and radius (m).
    """
    behind = compose(world, np.array([0.0, 0.0, -_SWEEP, 0.0, 0.0, 0.0, 1.0]))
    heights = np.minimum(*(compute_gripper_corners(poses)[..., 2].min(axis=1) for poses in (world, behind)))
    costs = compute_grasp_distances(hand, world, _ROTATION_COST, PAD_DISTANCE)
    costs += _TABLE_COST * (heights < TABLE_HEIGHT + _TABLE_CLEARANCE)
    if occluder[3] > 0.0:
        clearances = compute_grasp_clearances(world, Spheres(occluder[None, :3], occluder[3:]), _SWEEP)
        costs += _CLEARANCE_COST * np.maximum(0.0, _CLEARANCE - clearances)
    return costs
