"""Reactive human-to-robot handovers by grasp selection (Yang et al., ICRA 2021), as HandoverSim evaluates it.

Every 0.1 s the receiver ranks the object's known grasps by how near their standoff poses are to the pose chosen
last and to a preferred pose, moves to the best standoff that it can reach, and from there straight onto the
grasp; then it closes the fingers and carries the object to the goal. It knows the object's true pose and does
not look at the human hand.
"""

from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS
from handover_marl.episode.observations import Observation
from handover_marl.errors import ResetNeededError
from handover_marl.models.handiness import (
    CANDIDATES,
    PREFERRED_POSE,
    ROTATION_WEIGHT,
    STANDOFF,
    pose_distance,
)
from handover_marl.models.panda import CLOSED, OPEN, WAITING_JOINTS
from handover_marl.models.poses import compose, rotation_angle
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.waiting import wait_ms
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.solvers import PoseSolver, pose_solver

Pose = npt.NDArray[np.float64]


@dataclass(frozen=True)
class YangConfig:
    """Constants of the method (m, rad, s), as HandoverSim sets them.

    Attributes:
        wait_time: How long to stay at the waiting pose.
        decision_period: Time between decisions while approaching.
        close_time: How long the fingers close.
        standoff: Pose of the standoff in the hand link's frame at the grasp.
        preferred_pose: World pose of the hand that standoffs are drawn to.
        rotation_weight: Weight of rotations against squared distances.
        max_candidates: How many grasps are tried for reachability, cheapest first.
        region_width: Half width of the approach region at zero length.
        region_slope: Growth of the width with the region's length (1/m), relative to `region_width`.
        region_max_width: Largest half width.
        angle_tolerance: How well the hand must be turned, in the region and at the grasp.
        advance: Distance of one step from standoff to grasp.
        grasp_tolerance: How near to the grasp the fingers may close.
    """

    wait_time: float = 3.0
    decision_period: float = 0.1
    close_time: float = 0.5
    standoff: tuple[float, ...] = STANDOFF
    preferred_pose: tuple[float, ...] = PREFERRED_POSE
    rotation_weight: float = ROTATION_WEIGHT
    max_candidates: int = CANDIDATES
    region_width: float = 0.015
    region_slope: float = 50.0
    region_max_width: float = 0.04
    angle_tolerance: float = float(np.radians(15.0))
    advance: float = 0.05
    grasp_tolerance: float = 0.005


@dataclass(frozen=True)
class Approach:
    """A chosen grasp: world poses (7) of the hand link at the standoff and at the grasp."""

    standoff: Pose
    grasp: Pose


class Phase(Enum):
    """What the receiver is doing."""

    WAIT = auto()
    APPROACH = auto()
    CLOSE = auto()
    RETREAT = auto()


@dataclass
class Memory:
    """What the receiver carries from one decision to the next.

    Attributes:
        phase: What it is doing.
        approach: The grasp chosen last.
        reference: Standoff (7) that the next choice should stay near, if any.
        close_until: When the fingers are closed (s).
        retreat: The action that carries the object to the goal.
    """

    phase: Phase = Phase.WAIT
    approach: Approach | None = None
    reference: Pose | None = None
    close_until: float = 0.0
    retreat: Action | None = None


class Yang2021Receiver(Receiver):
    """The Yang et al. baseline.

    Asked every millisecond while the fingers close (the arm is then told to stay where it is), every 0.1 s
    before, and once after.

    Args:
        context: The robot, the task, the objects and their grasps.
        wait: How long to stay at the waiting pose (s), instead of what `config` says.
        config: The method's constants.
    """

    name = "yang2021"
    control_period = 0.1

    def __init__(self, context: PolicyContext, wait: float | None = None, config: YangConfig | None = None) -> None:
        super().__init__(context)
        self.config = config or YangConfig()
        if wait is not None:
            self.config = replace(self.config, wait_time=wait_ms(wait) / 1000.0)
        self._kinematics: PoseSolver | None = None
        self._grasps = ObjectGrasps(context.grasps)
        self._memory = Memory()

    def reset(self, seed: int | None = None) -> None:
        """Forget the chosen grasp; nothing here is random."""
        if self._kinematics is None:
            # Loaded here rather than at the first decision, where it would count as planning time.
            self._kinematics = pose_solver(self.context.panda_urdf, self.context.panda)
        self._memory = Memory()

    @property
    def wait(self) -> float:
        """How long it stays at the waiting pose (s)."""
        return self.config.wait_time

    @property
    def intention(self) -> npt.NDArray[np.float64] | None:
        """Standoff and grasp, until the fingers close."""
        chosen = self._memory.approach
        if chosen is None or self._memory.phase is not Phase.APPROACH:
            return None
        return np.stack([chosen.standoff, chosen.grasp])

    @property
    def hold_time(self) -> float:
        """Until the wait is over, the next decision, the next millisecond while closing, or for ever."""
        if self._memory.phase is Phase.WAIT:
            return self.config.wait_time or self.config.decision_period
        if self._memory.phase is Phase.APPROACH:
            return self.config.decision_period
        return 0.001 if self._memory.phase is Phase.CLOSE else float("inf")

    def act(self, observation: Observation) -> Action:
        """The next nine target joint positions."""
        time = round(float(observation["time"][0]), 3)
        if time < self.config.wait_time:
            return np.array(WAITING_JOINTS, dtype=np.float32)
        if self._memory.phase is Phase.WAIT:
            self._memory.phase = Phase.APPROACH
        if self._memory.phase is Phase.APPROACH:
            arm = self._decide(observation)
            if arm is not None:
                return _action(arm, OPEN)
            self._memory.phase = Phase.CLOSE
            self._memory.close_until = round(time + self.config.close_time, 3)
        if self._memory.phase is Phase.CLOSE and time < self._memory.close_until:
            return _action(_arm(observation), CLOSED)
        if self._memory.retreat is None:
            self._memory.phase = Phase.RETREAT
            self._memory.retreat = _action(self._arm_at_goal(observation), CLOSED)
        return self._memory.retreat

    def _decide(self, observation: Observation) -> npt.NDArray[np.floating] | None:
        """Arm joints to go to next, or None when the hand is at the grasp."""
        hand = observation["gripper_pose"]
        if self._memory.approach is None or not self._in_region(hand, self._memory.approach):
            return self._to_standoff(observation)
        if self._at_grasp(hand, self._memory.approach.grasp):
            return None
        return self._towards_grasp(observation, self._memory.approach.grasp)

    def _to_standoff(self, observation: Observation) -> npt.NDArray[np.floating]:
        grasps = self._grasps.in_world(observation)
        if grasps is None:
            return _arm(observation)
        standoffs = compose(grasps, np.array(self.config.standoff))
        cheapest = np.argsort(self._costs(standoffs, observation["gripper_pose"]), kind="stable")
        for index in cheapest[: self.config.max_candidates]:
            arm = self._solve(observation, standoffs[index])
            if arm is not None:
                self._memory.approach = Approach(standoff=standoffs[index], grasp=grasps[index])
                self._memory.reference = standoffs[index]
                return arm
        self._memory.reference = None
        return _arm(observation)

    def _towards_grasp(self, observation: Observation, grasp: Pose) -> npt.NDArray[np.floating]:
        hand = observation["gripper_pose"][:3]
        way = grasp[:3] - hand
        distance = float(np.linalg.norm(way))
        target = grasp.copy()
        if distance >= self.config.advance:
            # The reference rounds this set-point to float32, like the observation that it starts from.
            target[:3] = (hand + way / distance * self.config.advance).astype(np.float32)
        arm = self._solve(observation, target)
        return _arm(observation) if arm is None else arm

    def _arm_at_goal(self, observation: Observation) -> npt.NDArray[np.floating]:
        goal = self.context.protocol.goal_center
        arm = self._solver().solve(observation["robot_joint_position"], goal)
        return _arm(observation) if arm is None else arm

    def _costs(self, standoffs: Pose, hand: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        reference = hand if self._memory.reference is None else self._memory.reference
        weight = self.config.rotation_weight
        return pose_distance(reference, standoffs, weight) + pose_distance(
            self.config.preferred_pose, standoffs, weight
        )

    def _in_region(self, hand: npt.NDArray[np.float32], approach: Approach) -> bool:
        standoff, grasp = approach.standoff, approach.grasp
        angle = min(rotation_angle(hand[3:], standoff[3:]), rotation_angle(hand[3:], grasp[3:]))
        axis = grasp[:3] - standoff[:3]
        length = float(np.linalg.norm(axis))
        # The projection is divided by the length twice and clipped in between: the reference's own arithmetic.
        share = float(np.clip(np.dot(hand[:3] - standoff[:3], axis) / length, 0.0, 1.0)) / length
        distance = float(np.linalg.norm(standoff[:3] + share * axis - hand[:3]))
        config = self.config
        width = config.region_width * (1.0 + config.region_slope * length)
        return distance < min(width, config.region_max_width) and angle < config.angle_tolerance

    def _at_grasp(self, hand: npt.NDArray[np.float32], grasp: Pose) -> bool:
        near = float(np.linalg.norm(grasp[:3] - hand[:3])) < self.config.grasp_tolerance
        return near and rotation_angle(hand[3:], grasp[3:]) < self.config.angle_tolerance

    def _solve(self, observation: Observation, pose: Pose) -> npt.NDArray[np.float64] | None:
        return self._solver().solve(observation["robot_joint_position"], pose[:3], pose[3:])

    def _solver(self) -> PoseSolver:
        if self._kinematics is None:
            raise ResetNeededError("receiver 'yang2021' was asked to act before reset()")
        return self._kinematics


def _arm(observation: Observation) -> npt.NDArray[np.float32]:
    return observation["robot_joint_position"][:ARM_JOINTS]


def _action(arm: npt.NDArray[np.floating], fingers: float) -> Action:
    return np.concatenate([arm, [fingers, fingers]]).astype(np.float32)
