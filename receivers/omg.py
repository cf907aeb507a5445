"""A motion planner as a receiver: OMG (Wang et al., RSS 2020), as HandoverSim evaluates it.

Waits until the object is held out, plans once to one of the object's grasps, plays the trajectory without looking
again, closes the fingers and carries the object to the goal in a straight line. It knows the object's true pose.
`omg` does not look at the human hand; `omg_hand_aware` keeps clear of it. Both need the extra `planning`.
"""

import importlib.util
import logging
import math
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.models.arm import Arm
from handover_marl.models.panda import CLOSED, HALF_TURN, OPEN, WAITING_JOINTS
from handover_marl.models.poses import compose, compose_point, inverse, poses_from_rotations
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.planning.capsules import Capsules, hand_capsules
from handover_marl.planning.field_cache import object_field
from handover_marl.planning.grasp_rules import usable
from handover_marl.planning.obstacles import Obstacle
from handover_marl.planning.planner import Plan, Planner
from handover_marl.planning.planner_config import HandAvoidance, PlannerConfig
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.waiting import wait_ms
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.solvers import PoseSolver, pose_solver

Array = npt.NDArray[np.float64]

_Part = TypeVar("_Part")
_NEEDED = ("igl", "trimesh", "platformdirs")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OmgTiming:
    """When what happens, as HandoverSim sets it.

    Attributes:
        wait_ms: How long to stay at the waiting pose (ms).
        waypoint_ms: How long each waypoint is commanded (ms).
        close_ms: How long the fingers close (ms).
        retreat_step: Distance of points on the straight way to the goal (m).
    """

    wait_ms: int = 3000
    waypoint_ms: int = 130
    close_ms: int = 500
    retreat_step: float = 0.03


# Poses are told to the planner in steps of this (m, and shares of a quaternion): far below what a camera could tell.
_STEP = 1e-5


def _steady(poses: Array) -> Array:
    """(n, 7) poses rounded, quaternions with their largest number positive.

    Which of two goals that cost the same is chosen, and so the whole plan, hangs on the last bit of a pose, in which
    engines differ.
    """
    largest = np.abs(poses[:, 3:]).argmax(axis=1)
    signs = np.sign(np.take_along_axis(poses[:, 3:], largest[:, None], axis=1))
    found: Array = _STEP * np.round(np.concatenate([poses[:, :3], signs * poses[:, 3:]], axis=1) / _STEP)
    found[:, 3:] /= np.maximum(np.linalg.norm(found[:, 3:], axis=1, keepdims=True), _STEP)
    return found


class OmgReceiver(Receiver):
    """Plans once, then moves without looking.

    Args:
        context: The robot, the objects and their grasps.
        wait: How long to stay at the waiting pose (s), instead of what `timing` says.
        config: The planner's constants.
        timing: When what happens.

    Raises:
        OptionError: The extra `planning` is not installed.
    """

    name = "omg"
    # All times are multiples of it.
    control_period = 0.01
    #: The planner's constants unless others are given.
    default_config: ClassVar[PlannerConfig] = PlannerConfig()

    def __init__(
        self,
        context: PolicyContext,
        wait: float | None = None,
        config: PlannerConfig | None = None,
        timing: OmgTiming | None = None,
    ) -> None:
        super().__init__(context)
        missing = [module for module in _NEEDED if importlib.util.find_spec(module) is None]
        if missing:
            raise OptionError(
                f"receiver {self.name!r} needs {', '.join(missing)}: pip install 'handover-marl[planning]'"
            )
        self.config = config or self.default_config
        self.timing = timing or OmgTiming()
        if wait is not None:
            self.timing = replace(self.timing, wait_ms=wait_ms(wait))
        self._grasps = ObjectGrasps(context.grasps)
        #: (7,) where plans' base frame is.
        self.world_from_base = np.array([*context.panda.base_position, *context.panda.base_orientation])
        self._planner: Planner | None = None
        self._kinematics: PoseSolver | None = None
        self._planned = False
        self._plan: Plan | None = None
        self._retreat: list[Array] = []
        self._retreat_ms = 0
        self._until_ms: float = 0.0
        self._now_ms = 0

    @property
    def has_planned(self) -> bool:
        """Whether it has planned in this episode, with success or without."""
        return self._planned

    @property
    def plan(self) -> Plan | None:
        """The plan that is being played, if there is one."""
        return self._plan

    @property
    def arm(self) -> Arm:
        """The arm that plans are for."""
        return self._ready(self._planner).arm

    @property
    def wait(self) -> float:
        """How long it stays at the waiting pose (s)."""
        return self.timing.wait_ms / 1000.0

    @property
    def intention(self) -> Array | None:
        """The waypoints of the plan, also those behind it, until the fingers are closed."""
        if self._plan is None or self._retreat:
            return None
        chain = self.arm.chain(self._plan.trajectory)
        hand = poses_from_rotations(chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0))
        return compose(np.broadcast_to(self.world_from_base, hand.shape), hand)

    @property
    def hold_time(self) -> float:
        """Until the next command differs."""
        return (self._until_ms - self._now_ms) / 1000.0

    def reset(self, seed: int | None = None) -> None:
        """Forget the plan; nothing here is random."""
        if self._planner is None or self._kinematics is None:
            # Read here rather than when planning, where it would count as planning time.
            start = np.array(WAITING_JOINTS[:ARM_JOINTS])
            self._planner = Planner(self.context.panda_urdf, start, self.config)
            self._kinematics = pose_solver(self.context.panda_urdf, self.context.panda)
        self._planned, self._plan, self._retreat = False, None, []

    def act(self, observation: Observation) -> Action:
        """The next nine target joint positions."""
        self._now_ms = round(1000.0 * float(observation["time"][0]))
        into = self._now_ms - self.timing.wait_ms
        if into < 0:
            return self._command(np.array(WAITING_JOINTS[:ARM_JOINTS]), OPEN, self.timing.wait_ms)
        if not self._planned:
            self._plan, self._planned = self._make_plan(observation), True
        if self._plan is None:
            return self._command(np.array(WAITING_JOINTS[:ARM_JOINTS]), OPEN, math.inf)
        number = into // self.timing.waypoint_ms
        path = self._plan.trajectory
        if number < len(path):
            return self._command(path[number], OPEN, self._waypoint_start(number + 1))
        closed_ms = self._waypoint_start(len(path)) + self.timing.close_ms
        if self._now_ms < closed_ms:
            return self._command(path[-1], CLOSED, closed_ms)
        return self._carry(observation)

    def _command(self, arm: Array, fingers: float, until_ms: float) -> Action:
        self._until_ms = until_ms
        return np.array([*arm, fingers, fingers], dtype=np.float32)

    def _waypoint_start(self, number: int) -> int:
        return self.timing.wait_ms + number * self.timing.waypoint_ms

    def _make_plan(self, observation: Observation) -> Plan | None:
        name = CLASS_NAMES[int(observation["object_classes"][0])]
        grasps = self._grasps.in_object(name)
        if grasps is None:
            _log.warning("%s: no grasps are known of %r; staying at the start pose", self.name, name)
            return None
        grasps = compose(grasps, np.array(HALF_TURN))
        grasps = grasps[usable(name, grasps)]
        base_from_world = inverse(self.world_from_base)
        base_from_objects = compose(base_from_world, _steady(observation["object_poses"].astype(np.float64)))
        plan = self._ready(self._planner).plan(
            compose(base_from_objects[0], grasps),
            self._obstacles(observation, base_from_objects),
            self._hand(observation, base_from_world),
        )
        if plan is None:
            _log.warning("%s: no grasp of %r can be reached; staying at the start pose", self.name, name)
        return plan

    def _obstacles(self, observation: Observation, base_from_objects: Array) -> list[Obstacle]:
        padding = self.config.costs.padding
        present = np.flatnonzero(observation["object_mask"])
        names = [CLASS_NAMES[int(observation["object_classes"][number])] for number in present]
        return [
            Obstacle(object_field(self.context.object_urdf(name), padding), base_from_objects[number], padding)
            for number, name in zip(present, names, strict=True)
        ]

    def _hand(self, observation: Observation, base_from_world: Array) -> Capsules | None:
        hand = None if self.config.hand is None else hand_capsules(observation)
        if hand is None:
            return None
        starts, ends = (compose_point(base_from_world, points) for points in (hand.starts, hand.ends))
        return replace(hand, starts=starts, ends=ends)

    def _carry(self, observation: Observation) -> Action:
        if not self._retreat:
            self._retreat, self._retreat_ms = self._way_to_goal(observation), self._now_ms
        number = (self._now_ms - self._retreat_ms) // self.timing.waypoint_ms
        if number >= len(self._retreat) - 1:
            return self._command(self._retreat[-1], CLOSED, math.inf)
        until = self._retreat_ms + (number + 1) * self.timing.waypoint_ms
        return self._command(self._retreat[number], CLOSED, until)

    def _way_to_goal(self, observation: Observation) -> list[Array]:
        """Arm joints (7,) along the straight line from where the hand is to the goal, its turn left free."""
        hand = observation["gripper_pose"][:3].astype(np.float64)
        goal = np.array(self.context.protocol.goal_center)
        count = max(1, math.ceil(float(np.linalg.norm(goal - hand)) / self.timing.retreat_step))
        arm = observation["robot_joint_position"][:ARM_JOINTS].astype(np.float64)
        way = []
        for share in np.arange(1, count + 1) / count:
            found = self._ready(self._kinematics).solve([*arm, CLOSED, CLOSED], hand + share * (goal - hand))
            arm = arm if found is None else found
            way.append(arm)
        return way

    def _ready(self, part: _Part | None) -> _Part:
        if part is None:
            raise ResetNeededError(f"receiver {self.name!r} was asked to act before reset()")
        return part


class OmgHandAwareReceiver(OmgReceiver):
    """The same with the person's hand as an obstacle: goals beside it, and a way that keeps clear of it."""

    name = "omg_hand_aware"
    default_config = PlannerConfig(hand=HandAvoidance())


class OmgUncheckedLastReceiver(OmgReceiver):
    """The same with the slip of the original that decides which goal it takes most often."""

    name = "omg_unchecked_last"
    default_config = PlannerConfig(unchecked_last=True)
