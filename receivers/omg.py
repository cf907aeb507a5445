"""OMG motion planner (Wang et al., RSS 2020) as a receiver, as in HandoverSim.

The receiver waits for a fixed time, 3 s by default. Then it plans once to one of the object's grasps, executes the
trajectory without feedback, closes the fingers and carries the object to the goal in a straight line. It uses the true
poses of the objects. `omg` ignores the person's hand, `omg_hand_aware` keeps clear of the hand, and
`omg_unchecked_last` is `omg` with an error of the authors' code. All variants need the extra `planning`.
"""

import logging
import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.execution.options import require_modules
from handover_marl.geometry.arm import ArmKinematics, IkSolver
from handover_marl.geometry.distance_field import load_object_sdf
from handover_marl.geometry.panda import CLOSED, HALF_TURN, OPEN, WAITING_JOINTS
from handover_marl.geometry.poses import compose, invert_pose, poses_from_rotations, transform_points
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.planning.goal_set import is_usable_grasp
from handover_marl.planning.hand_tracker import Capsules, hand_capsules_from_observation
from handover_marl.planning.ik_solvers import ThreadIkSolver
from handover_marl.planning.planner import OBJECT_PADDING, Plan, Planner, PlannerConfig
from handover_marl.planning.trajectory_cost import Obstacle
from handover_marl.policies.policy import Action, PolicyContext, require_reset
from handover_marl.receivers.phased_receiver import CLOSE_MS, RETREAT_STEP, PhasedReceiver

Array = npt.NDArray[np.float64]

# Resolution of the planner's input poses (m, and components of a quaternion), far below the accuracy of a camera.
_POSE_RESOLUTION = 1e-5
_log = logging.getLogger(__name__)


def round_poses(poses: Array) -> Array:
    """Round poses (n, 7), xyz (m) and quaternion xyzw, to 1e-5; make the largest quaternion component positive.

    Physics engines differ in the last bits of a pose. Without rounding, these bits would decide between goals of equal
    cost, and so change the whole plan.
    """
    largest = np.abs(poses[:, 3:]).argmax(axis=1)
    signs = np.sign(np.take_along_axis(poses[:, 3:], largest[:, None], axis=1))
    canonical = np.concatenate([poses[:, :3], signs * poses[:, 3:]], axis=1)
    rounded: Array = _POSE_RESOLUTION * np.round(canonical / _POSE_RESOLUTION)
    rounded[:, 3:] /= np.maximum(np.linalg.norm(rounded[:, 3:], axis=1, keepdims=True), _POSE_RESOLUTION)
    return rounded


class OmgReceiver(PhasedReceiver):
    """Receiver that plans a trajectory to a grasp once and executes it without feedback.

    Args:
        context: The robot, the objects and their grasps.
        wait: Time at the waiting pose (s); default: 3.
        config: Configuration of the planner.

    Attributes:
        world_from_base: (7,) world pose (quaternion xyzw) of the robot's base; plans are in the base's frame.
        has_planned: Whether the receiver has tried to plan in this episode.
        plan: Planned trajectory of this episode; None before planning, or if no grasp is reachable.
    """

    name = "omg"
    step_ms = 130
    #: Configuration of the planner unless another is given.
    default_config: ClassVar[PlannerConfig] = PlannerConfig()

    def __init__(self, context: PolicyContext, wait: float | None = None, config: PlannerConfig | None = None) -> None:
        super().__init__(context, wait)
        require_modules(f"receiver {self.name!r}", "planning", "igl", "trimesh")
        self.config = config or self.default_config
        self.world_from_base = np.array([*context.panda.base_position, *context.panda.base_orientation])
        self._planner: Planner | None = None
        self._ik_solver: IkSolver | None = None
        self.has_planned = False
        self.plan: Plan | None = None
        self._retreat_ms = 0

    @property
    def arm(self) -> ArmKinematics:
        """Kinematics of the arm in the frame of the robot's base."""
        return require_reset(self._planner, self.name).arm

    @property
    def planned_goal(self) -> Array | None:
        """(w, 7) world poses (xyzw) of the hand link at the plan's waypoints; None without a plan or in the retreat."""
        if self.plan is None or self._retreat:
            return None
        chain = self.arm.compute_chain_frames(self.plan.trajectory)
        hand = poses_from_rotations(chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0))
        return np.asarray(compose(np.broadcast_to(self.world_from_base, hand.shape), hand))

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; `seed` is ignored, since the receiver is deterministic."""
        if self._planner is None or self._ik_solver is None:
            # Loaded here so that it does not count as planning time.
            start = np.array(WAITING_JOINTS[:ARM_DOF])
            self._planner = Planner(self.context.panda_urdf, start, self.config)
            self._ik_solver = ThreadIkSolver(self.context.panda_urdf, self.context.panda)
        self._reset_timing()
        self.has_planned, self.plan = False, None

    def act(self, observation: Observation) -> Action:
        """Return target joint positions (9,): arm (rad), fingers (m); without a plan, keep the waiting pose."""
        self._now_ms = round(1000.0 * float(observation["time"][0]))
        elapsed = self._now_ms - self._wait_ms
        if elapsed < 0:
            return self._command(np.array(WAITING_JOINTS[:ARM_DOF]), OPEN, self._wait_ms)
        if not self.has_planned:
            self.plan, self.has_planned = self._make_plan(observation), True
        if self.plan is None:
            return self._command(np.array(WAITING_JOINTS[:ARM_DOF]), OPEN, math.inf)
        number = elapsed // self.step_ms
        path = self.plan.trajectory
        if number < len(path):
            return self._command(path[number], OPEN, self._compute_waypoint_start(number + 1))
        closed_ms = self._compute_waypoint_start(len(path)) + CLOSE_MS
        if self._now_ms < closed_ms:
            return self._command(path[-1], CLOSED, closed_ms)
        if not self._retreat:
            self._retreat_ms = self._now_ms
        return self._carry(observation, self._retreat_ms)

    def _compute_waypoint_start(self, number: int) -> int:
        return self._wait_ms + number * self.step_ms

    def _make_plan(self, observation: Observation) -> Plan | None:
        name = self.context.object_names[int(observation["object_classes"][0])]
        grasps = load_hand_poses(self.context.load_grasps, name)
        if grasps is None:
            _log.warning("%s: no grasps of %r are known; staying at the start pose", self.name, name)
            return None
        grasps = compose(grasps, np.array(HALF_TURN))
        grasps = grasps[is_usable_grasp(name, grasps)]
        base_from_world = invert_pose(self.world_from_base)
        object_poses = round_poses(observation["object_poses"].astype(np.float64))
        base_from_objects = compose(base_from_world, object_poses)
        plan = require_reset(self._planner, self.name).plan(
            compose(base_from_objects[0], grasps),
            self._make_obstacles(observation, base_from_objects),
            self._find_human_hand(observation, base_from_world),
        )
        if plan is None:
            _log.warning("%s: no grasp of %r can be reached; staying at the start pose", self.name, name)
        return plan

    def _make_obstacles(self, observation: Observation, base_from_objects: Array) -> list[Obstacle]:
        """Return the objects of the scene as obstacles, given their poses (5, 7; xyzw) in the robot's base frame."""
        present = np.flatnonzero(observation["object_mask"])
        names = [self.context.object_names[int(observation["object_classes"][number])] for number in present]
        urdfs = [self.context.find_object_urdf(name) for name in names]
        return [
            Obstacle(load_object_sdf(urdf, OBJECT_PADDING), base_from_objects[number], OBJECT_PADDING)
            for number, urdf in zip(present, urdfs, strict=True)
        ]

    def _find_human_hand(self, observation: Observation, base_from_world: Array) -> Capsules | None:
        """Return capsules of the person's hand in the base frame; None without a hand, or if the planner ignores it."""
        hand = hand_capsules_from_observation(observation) if self.config.avoids_hand else None
        if hand is None:
            return None
        starts, ends = (transform_points(base_from_world, points) for points in (hand.starts, hand.ends))
        return replace(hand, starts=starts, ends=ends)

    def _plan_retreat(self, observation: Observation) -> list[Array]:
        """Return arm joints (7,) (rad) at waypoints on the straight line to the goal.

        The hand link may rotate freely. A waypoint without an IK solution repeats the joints before it.
        """
        hand = observation["gripper_pose"][:3].astype(np.float64)
        goal = np.array(self.context.protocol.goal_center)
        count = max(1, math.ceil(float(np.linalg.norm(goal - hand)) / RETREAT_STEP))
        arm = observation["robot_joint_position"][:ARM_DOF].astype(np.float64)
        solver, path = require_reset(self._ik_solver, self.name), []
        for share in np.arange(1, count + 1) / count:
            joints = solver.solve([*arm, CLOSED, CLOSED], hand + share * (goal - hand))
            arm = arm if joints is None else joints
            path.append(arm)
        return path


class OmgHandAwareReceiver(OmgReceiver):
    """OMG receiver that avoids the person's hand, in its choice of a grasp and on its path."""

    name = "omg_hand_aware"
    default_config = PlannerConfig(avoids_hand=True)


class OmgUncheckedLastReceiver(OmgReceiver):
    """OMG receiver with the authors' indexing error, which selects most grasps; see `PlannerConfig.unchecked_last`."""

    name = "omg_unchecked_last"
    default_config = PlannerConfig(unchecked_last=True)
