"""Selection of a grasp and of the path to this grasp, for the receivers `reactive` and `vision`."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT
from handover_marl.geometry.arrays import Indices
from handover_marl.geometry.panda import HALF_TURN, WAITING_JOINTS
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.grasps.graspable_object import GraspableObject, compute_hold_costs, find_offset_grasps
from handover_marl.grasps.validation import ValidatedGrasps
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.collision_avoidance import PathObstacles, find_via_point, is_path_clear
from handover_marl.planning.robot_clearance import (
    Spheres,
    compute_arm_clearances,
    compute_grasp_clearances,
    compute_gripper_corners,
    compute_lowest_heights,
)
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.scene_estimate import SceneEstimate

Array = npt.NDArray[np.float64]

HOME = np.array(WAITING_JOINTS[:7])
#: Configurations at which inverse kinematics starts. They were chosen greedily to find solutions for most of the poses
#: that the arm reaches quickly from its waiting pose.
IK_SEEDS = np.array(
    [
        HOME,
        (-0.386, 0.559, 0.048, -2.175, -1.173, 1.994, 0.797),
        (0.276, 0.693, 0.397, -2.782, 1.358, 2.557, -0.02),
    ]
)
#: Further start configurations, used after a decision in which `IK_SEEDS` led to no reachable grasp.
FALLBACK_IK_SEEDS = np.array(
    [
        (0.641, -1.612, -0.197, -2.53, -0.095, 1.678, 0.587),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 1.678, -0.913),
        (-0.059, -1.612, -1.097, -2.53, -0.095, 1.678, 0.587),
        (0.7, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 0.878, 0.587),
        (2.0, 0.23, -2.85, -1.69, 0.056, 1.46, -1.27),
    ]
)
_STANDOFF_ITERATIONS, _GRASP_ITERATIONS = 12, 6
_NO_HAND_CLEARANCE = 0.2  # m
# Costs that are added to the travel time of the arm: for rotating the hand link from its waiting pose (s/rad), missing
# clearance to other objects (s/m), missing distance to joint limits (s/rad), a path that is not clear (s), and a grasp
# that has failed in this episode (s).
_ROTATION_COST, _OBSTACLE_COST, _LIMIT_MARGIN_COST, _BLOCKED_PATH_COST, _FAILED_COST = 0.5, 100.0, 2.0, 2.0, 10.0
_DESIRED_OBSTACLE_CLEARANCE, _DESIRED_LIMIT_MARGIN = 0.02, 0.3  # m, rad
# Minimum clearances (m): of gripper and arm to the table, of forearm and wrist to all bodies, and on paths.
_TABLE_CLEARANCE, _ARM_CLEARANCE, _PATH_CLEARANCE = 0.005, 0.005, 0.01
# Rate at which the minimum clearance to the hand decreases while no grasp satisfies it (m/s), and factor on this rate
# while some grasps satisfy it but none is in reach.
_CLEARANCE_RELAXATION, _UNREACHABLE_RELAXATION = 0.01, 0.3
# Hold cost above which a grasp counts as poor (s), and factor on the maximum number of candidates after offset grasps
# were added.
_POOR_HOLD_COST, _OFFSET_CANDIDATE_FACTOR = 1.5, 4
# Maximum numbers of paths and via points that are checked in a decision, and maximum joint change between standoff and
# grasp (rad).
_MAX_PATH_CHECKS, _MAX_VIA_POINTS, _MAX_JOINT_CHANGE = 6, 24, 0.8
# Cost difference above which another grasp replaces the selected one, and its increase near the selected one (s).
_SWITCH_MARGIN, _NEAR_SWITCH_MARGIN = 0.3, 0.5
# Cost of a grasp that must not be selected (s); sums of all other costs are lower.
_FORBIDDEN = 100.0
# After this many batches of candidates without a reachable one, only every tenth decision searches.
_MAX_BATCHES, _RARE_SEARCH_PERIOD = 40, 10
# Largest distance of the gripper, on its approach, from the grasped object's origin (m).
_GRIPPER_REACH = 0.45


@dataclass(frozen=True, eq=False)
class GraspGoal:
    """Selected grasp with the arm configurations on the path to the grasp.

    Attributes:
        number: Index of the grasp in `GraspSelector.grasps`.
        standoff_joints: (7,) configuration of the arm at the standoff (rad).
        grasp_joints: (7,) configuration of the arm at the grasp (rad).
        via_joints: (7,) via point of the joint path to the standoff around an obstacle (rad); None: straight path.
    """

    number: int
    standoff_joints: Array
    grasp_joints: Array
    via_joints: Array | None = None


class GraspSelector:
    """Selector of the cheapest reachable grasp. The selection changes only to a clearly cheaper one (hysteresis).

    Args:
        arm: Kinematics of the arm.
        speeds: (7,) maximum joint speeds (rad/s).
        config: Configuration of the receiver.

    Attributes:
        grasps: (n, 7) candidate poses of the hand link in the object's frame, quaternion xyzw.
        surface: Spheres that approximate the object's surface, in the object's frame.
        chosen: Grasp that was selected last; None if there is no selection.
        failure_reason: Reason why no grasp could be selected; empty after a selection.
        failed: Times of the episode (s) until which failed grasps have a higher cost, by index in `grasps`.
    """

    def __init__(self, arm: ArmInWorld, speeds: Array, config: ReactiveConfig) -> None:
        self._arm, self._speeds, self._config, self._receiver_config = arm, speeds, config.selection, config
        self._grasp_from_standoff = np.array([0.0, 0.0, -config.approach.standoff, 0.0, 0.0, 0.0, 1.0])
        self._home_rotation = Rotation.from_quat(arm.compute_hand_pose(HOME)[3:])
        self.reset()

    def reset(self) -> None:
        """Remove all candidates and failed grasps, at the start of an episode."""
        self.grasps, self._hold_costs = np.zeros((0, 7)), np.zeros(0)
        self.surface = Spheres(np.zeros((1, 3)), np.zeros(1))
        self._object: GraspableObject | None = None
        self.chosen: GraspGoal | None = None
        self.failure_reason = ""
        self.failed: dict[int, float] = {}
        self._batch, self._relaxing_time, self._poor_time = 0, 0.0, 0.0
        self._has_offsets = False

    def set_object(self, graspable: GraspableObject) -> None:
        """Reset the selector; set the candidates to an object's grasps and their half turns about the approach axis."""
        self.reset()
        self._object, self.surface = graspable, graspable.surface
        self._add(graspable.grasps, graspable.pad_margins, 0.0)

    def set_candidates(self, poses: Array, costs: Array, surface: Spheres, chosen: int | None) -> None:
        """Replace the candidate grasps, and clear `failed`.

        Args:
            poses: (n, 7) poses of the hand link in the object's frame, quaternion xyzw.
            costs: (n,) costs (s), higher for grasps that may not hold or have failed before.
            surface: Spheres that approximate the object, in its frame.
            chosen: Index in `poses` of the selected grasp, if there is one; None clears the selection.
        """
        self.surface, self.failed = surface, {}
        self.grasps, self._hold_costs = poses, costs
        if self.chosen is not None:
            self.chosen = None if chosen is None else replace(self.chosen, number=chosen)

    def give_up(self, until: float) -> None:
        """Increase the cost of the selected grasp until a time (s) of the episode, and clear the selection."""
        if self.chosen is not None:
            self.failed[self.chosen.number] = until
        self.chosen = None

    def select(self, scene: SceneEstimate, is_near: bool = False) -> GraspGoal | None:
        """Return the grasp to approach: the previous one unless another is clearly cheaper; None if all are unsuitable.

        If the gripper `is_near` the previous grasp, another one must be cheaper by a larger margin.
        """
        self._add_offset_grasps(scene)
        if self._has_offsets and self._batch > _MAX_BATCHES and self._batch % _RARE_SEARCH_PERIOD:
            # All candidates have been examined: only another position of the human hand can help.
            self._batch += 1
            return None
        handover_pose, joints = scene.motion.predict_handover_pose(), scene.arm_joints
        world = compose(handover_pose, self.grasps)
        rough = self._compute_rough_costs(world, self._compute_clearances(scene), scene.time)
        rough = rough + self._compute_obstacle_costs(world, scene, handover_pose)
        numbers = self._select_candidates(rough)
        if not len(numbers):
            self._report_failure("no clearance", scene.is_settled, 1.0)
            return None
        bodies = scene.predict_bodies(handover_pose, self.surface)
        obstacles = PathObstacles(bodies, TABLE_HEIGHT, _PATH_CLEARANCE)
        costs, standoffs, goals = self._compute_costs(rough[numbers], world[numbers], joints, obstacles.spheres)
        best = self._choose_with_hysteresis(numbers, costs, standoffs, joints, obstacles, is_near)
        if costs[best] >= _FORBIDDEN:
            self._batch += 1
            self._report_failure("out of reach", scene.is_settled, _UNREACHABLE_RELAXATION)
            return None
        number = int(numbers[best])
        self._batch, self.failure_reason = 0, ""
        is_poor = self._hold_costs[number] > _POOR_HOLD_COST
        self._poor_time += self._receiver_config.period if is_poor else 0.0
        via = None if is_near else self._find_via_point(standoffs[best], joints, obstacles)
        self.chosen = GraspGoal(number, standoffs[best], goals[best], via)
        return self.chosen

    def compute_grasp_pose(self, goal: GraspGoal, object_pose: Array) -> Array:
        """Return the hand link's world pose (7,) at a grasp, given the object's world pose (7,); quaternions xyzw."""
        return np.asarray(compose(object_pose, self.grasps[goal.number]))

    def compute_standoff_pose(self, grasp_pose: Array) -> Array:
        """Return the hand link's pose (7,) at the standoff behind `grasp_pose` (7,), in the same frame; both xyzw."""
        return np.asarray(compose(grasp_pose, self._grasp_from_standoff))

    def compute_pose_in_grasp(self, goal: GraspGoal, object_pose: Array, gripper_pose: Array) -> Array:
        """Return the hand link's pose (7,) in a grasp's frame, given world poses of object and hand link (all xyzw)."""
        return np.asarray(compose(invert_pose(self.compute_grasp_pose(goal, object_pose)), gripper_pose))

    def _add(self, grasps: ValidatedGrasps, pad_margins: Array, cost: float) -> None:
        """Add grasps with pad margins (n,) in m, and their half turns, to the candidates, at an extra `cost` (s)."""
        costs = cost + compute_hold_costs(grasps, pad_margins, self._config.partial_hold_cost)
        self.grasps = np.concatenate([self.grasps, grasps.poses, compose(grasps.poses, np.array(HALF_TURN))])
        self._hold_costs = np.concatenate([self._hold_costs, costs, costs])

    def _add_offset_grasps(self, scene: SceneEstimate) -> None:
        """Add offset copies of the object's grasps, at most once, after `offset_delay` with only poor grasps."""
        if self._poor_time <= self._config.offset_delay or self._has_offsets or self._object is None:
            return
        human_hand = scene.hand_in_object
        if human_hand is not None:
            grasps, margins = find_offset_grasps(self._object, human_hand, self._receiver_config.approach.standoff)
            self._add(grasps, margins, self._config.offset_cost)
            self._has_offsets = True

    def _report_failure(self, reason: str, is_settled: bool, relaxation: float) -> None:
        if is_settled:
            self._relaxing_time += relaxation * self._receiver_config.period
            self._poor_time += self._receiver_config.period
        self.chosen, self.failure_reason = None, reason

    def _compute_clearances(self, scene: SceneEstimate) -> Array:
        """Return the clearances (n,) in m of the gripper to the person's hand at the candidates; 0.2 without a hand."""
        human_hand = scene.hand_in_object
        if human_hand is None:
            return np.full(len(self.grasps), _NO_HAND_CLEARANCE)
        return compute_grasp_clearances(self.grasps, human_hand, self._receiver_config.approach.standoff)

    def _compute_rough_costs(self, world: Array, clearances: Array, time: float) -> Array:
        """Return costs (n,) in s that need no IK, of grasps at world poses (n, 7) with hand clearances (n,) in m."""
        config = self._config
        rotations = (self._home_rotation.inv() * Rotation.from_quat(world[:, 3:])).magnitude()
        missing = np.maximum(0.0, config.desired_clearance - clearances)
        costs: Array = self._hold_costs + _ROTATION_COST * rotations + config.clearance_cost * missing
        relaxed = config.min_clearance - _CLEARANCE_RELAXATION * self._relaxing_time
        costs[clearances < max(config.hard_min_clearance, relaxed)] += _FORBIDDEN
        poses = (world, compose(world, self._grasp_from_standoff))
        heights = np.minimum(*(compute_gripper_corners(pose)[..., 2].min(axis=1) for pose in poses))
        costs[heights < TABLE_HEIGHT + _TABLE_CLEARANCE] += _FORBIDDEN
        for number, until in self.failed.items():
            if time < until:
                costs[number] += _FAILED_COST
        return costs

    def _compute_obstacle_costs(self, world: Array, scene: SceneEstimate, handover_pose: Array) -> Array | float:
        """Return costs (n,) in s of missing clearance to other objects, for grasps (n, 7); 0 if no object is near."""
        if scene.obstacles is None:
            return 0.0
        near = scene.obstacles.select_within(handover_pose[:3], _GRIPPER_REACH)
        if not len(near.radii):
            return 0.0
        clearances = compute_grasp_clearances(world, near, self._receiver_config.approach.standoff)
        missing = np.maximum(0.0, _DESIRED_OBSTACLE_CLEARANCE - clearances)
        return np.asarray(_OBSTACLE_COST * missing)

    def _select_candidates(self, costs: Array) -> Indices:
        """Return indices of a batch of the cheapest grasps (after failed searches, a later batch) and of `chosen`."""
        order = np.argsort(costs, kind="stable")
        order = order[costs[order] < _FORBIDDEN]
        count = self._config.max_candidates * (_OFFSET_CANDIDATE_FACTOR if self._has_offsets else 1)
        numbers = np.roll(order, -self._batch * count)[:count]
        if len(numbers) and self.chosen is not None and self.chosen.number not in numbers:
            numbers = np.append(numbers, self.chosen.number)
        return numbers

    def _compute_costs(self, rough: Array, world: Array, joints: Array, bodies: Spheres) -> tuple[Array, Array, Array]:
        """Return costs (k,) in s of k grasps, without path costs, and arm joints (k, 7) at standoffs and at grasps.

        `rough` (k,) are costs before inverse kinematics, `world` (k, 7) world poses of grasps; the arm is at `joints`.
        """
        # The previous solution is a seed, so that one from a fallback seed is not lost again.
        previous = None if self.chosen is None else self.chosen.standoff_joints
        standoffs, goals, is_reached = self._solve_ik(world, joints, previous, self._batch > 0)
        costs = rough + self._compute_travel_times(standoffs, joints)
        costs = costs + self._compute_limit_margin_costs(standoffs, goals)
        is_usable = is_reached.copy()
        is_usable[is_reached] = self._is_arm_clear(goals[is_reached], bodies)
        costs[~is_usable] += _FORBIDDEN
        return costs, standoffs, goals

    def _solve_ik(
        self, grasps: Array, joints: Array, previous: Array | None, use_fallback: bool
    ) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Solve inverse kinematics of grasps (n, 7) of the hand link and their standoffs from several seeds.

        For each grasp, the solution that the arm at `joints` reaches soonest is returned: configurations (n, 7)
        in rad at the standoffs and at the grasps, and a mask (n,) of grasps with a solution. Seeds are `IK_SEEDS`, the
        configuration `previous` unless None, and with `use_fallback` also `FALLBACK_IK_SEEDS`.
        """
        seeds = np.concatenate([IK_SEEDS, FALLBACK_IK_SEEDS]) if use_fallback else IK_SEEDS
        if previous is not None:
            seeds = np.concatenate([previous[None], seeds])
        count, copies = len(grasps), len(seeds)
        poses = np.tile(grasps, (copies, 1))
        standoff_poses = compose(poses, self._grasp_from_standoff)
        standoffs, found = self._arm.solve(standoff_poses, np.repeat(seeds, count, axis=0), _STANDOFF_ITERATIONS)
        goals, is_goal_found = self._arm.solve(poses, standoffs, _GRASP_ITERATIONS)
        found &= is_goal_found & (np.abs(goals - standoffs).max(axis=1) < _MAX_JOINT_CHANGE)
        times = np.where(found, self._compute_travel_times(standoffs, joints), np.inf).reshape(copies, count)
        best = np.argmin(times, axis=0) * count + np.arange(count)
        return standoffs[best], goals[best], found[best]

    def _compute_travel_times(self, standoffs: Array, joints: Array) -> Array:
        """Return the travel times (n,) in s of the arm from joints (7,) to standoff configurations (n, 7)."""
        return np.asarray((np.abs(standoffs - joints) / self._speeds).max(axis=1))

    def _compute_limit_margin_costs(self, standoffs: Array, goals: Array) -> Array:
        """Return costs (n,) in s of grasps at which, or at whose standoffs, joints (n, 7) are close to their limits."""
        low, high = self._arm.limits
        margins = np.minimum(*(np.minimum(joints - low, high - joints).min(axis=1) for joints in (standoffs, goals)))
        missing = np.maximum(0.0, _DESIRED_LIMIT_MARGIN - margins)
        return np.asarray(_LIMIT_MARGIN_COST * missing)

    def _is_arm_clear(self, goals: Array, bodies: Spheres) -> npt.NDArray[np.bool_]:
        """Return a mask (n,) of configurations (n, 7) at which arm (elbow to wrist) is clear of bodies and table."""
        is_clear = compute_arm_clearances(self._arm, goals, bodies) > _ARM_CLEARANCE
        lowest = compute_lowest_heights(self._arm, goals)
        return np.asarray(is_clear & (lowest > TABLE_HEIGHT + _TABLE_CLEARANCE))

    def _choose_with_hysteresis(
        self, numbers: Indices, costs: Array, standoffs: Array, joints: Array, obstacles: PathObstacles, is_near: bool
    ) -> int:
        """Return the position in `numbers` of the grasp selected before, or of the cheapest if it is clearly cheaper.

        Unless `is_near` (the gripper is near the grasp), costs of blocked paths are added to `costs`.
        """
        old = None if self.chosen is None else int(np.flatnonzero(numbers == self.chosen.number)[0])
        best = int(np.argmin(costs)) if is_near else self._add_path_costs(costs, standoffs, old, joints, obstacles)
        margin = _SWITCH_MARGIN + (_NEAR_SWITCH_MARGIN if is_near else 0.0)
        if self.chosen is not None and self.chosen.via_joints is not None:
            margin += _BLOCKED_PATH_COST
        if old is not None and costs[old] < min(costs[best] + margin, _FORBIDDEN):
            best = old
        return best

    def _add_path_costs(
        self, costs: Array, standoffs: Array, old: int | None, joints: Array, obstacles: PathObstacles
    ) -> int:
        """Add the costs of blocked paths to `costs` (k,), for the grasp at position `old` and the cheapest ones.

        Returns:
            Position of the grasp that is the cheapest afterwards.
        """
        checked = set[int]()
        best = int(np.argmin(costs)) if old is None else old
        while best not in checked and len(checked) < _MAX_PATH_CHECKS:
            checked.add(best)
            if not is_path_clear(self._arm, joints, standoffs[best], obstacles):
                costs[best] += _BLOCKED_PATH_COST
            best = int(np.argmin(costs))
        return best

    def _find_via_point(self, standoff: Array, joints: Array, obstacles: PathObstacles) -> Array | None:
        """Return a via point (7,) from joints to a standoff; None if the straight path is clear, or none is found."""
        if is_path_clear(self._arm, joints, standoff, obstacles):
            return None
        previous = None if self.chosen is None else self.chosen.via_joints
        if previous is not None and all(
            is_path_clear(self._arm, start, end, obstacles) for start, end in ((joints, previous), (previous, standoff))
        ):
            return previous
        known = np.concatenate([IK_SEEDS, FALLBACK_IK_SEEDS])
        return find_via_point(self._arm, joints, standoff, known, self._speeds, obstacles, _MAX_VIA_POINTS)
