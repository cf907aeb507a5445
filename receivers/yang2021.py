"""Reactive handovers by grasp selection (Yang et al., ICRA 2021), as in HandoverSim.

Every 0.1 s the receiver ranks the object's known grasps by the distance of their standoff poses
from the pose selected last and from a preferred pose. It moves to the best reachable standoff, from
there straight to the grasp, closes the fingers and carries the object to the goal. It uses the
object's true pose and ignores the person's hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry import panda
from handover_marl.geometry.poses import compose, compute_pose_distances, compute_rotation_angle
from handover_marl.planning.ik_solvers import IkSolver, make_ik_solver
from handover_marl.policies.policy import Action, PolicyContext, Receiver, milliseconds_from_wait, require_reset
from handover_marl.receivers.grasp_library import GraspLibrary

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class YangConfig:
    """Constants of the method of Yang et al. (2021), as in HandoverSim.

    Attributes:
        wait_time: Time at the waiting pose (s).
        decision_period: Time between decisions during the approach (s).
        close_time: Time for which the fingers close (s).
        standoff: (7,) standoff pose of the hand link, in the frame of the hand link at the grasp.
        preferred_pose: (7,) world pose of the hand link near which a standoff has a low cost.
        rotation_weight: Weight of rotations relative to squared distances in a standoff's cost.
        max_candidates: Maximum number of grasps that are checked for reachability.
        region_width: Half width, for a standoff at the grasp, of the region around the line from
            standoff to grasp in which the hand moves straight to the grasp (m).
        region_slope: Growth of the region's width with the distance of the standoff from the grasp
            (1/m), relative to `region_width`.
        region_max_width: Maximum half width of the region around the line (m).
        angle_tolerance: Maximum rotation error of the hand in the region and at the grasp (rad).
        step_length: Length of a step from standoff to grasp (m).
        grasp_tolerance: Maximum distance from the grasp at which the fingers close (m).
    """

    wait_time: float = 3.0
    decision_period: float = 0.1
    close_time: float = 0.5
    standoff: tuple[float, ...] = panda.RANKING_STANDOFF
    preferred_pose: tuple[float, ...] = panda.PREFERRED_HAND_POSE
    rotation_weight: float = panda.RANKING_ROTATION_WEIGHT
    max_candidates: int = panda.MAX_RANKED_GRASPS
    region_width: float = 0.015
    region_slope: float = 50.0
    region_max_width: float = 0.04
    angle_tolerance: float = float(np.radians(15.0))
    step_length: float = 0.05
    grasp_tolerance: float = 0.005


class YangPhase(Enum):
    """Phase of a handover with the method of Yang et al. (2021)."""

    WAIT = auto()
    APPROACH = auto()
    CLOSE = auto()
    RETREAT = auto()


class Yang2021Receiver(Receiver):
    """Receiver `yang2021`, the reactive baseline of Yang et al. (2021).

    The receiver decides every 0.1 s during the approach, every millisecond while the fingers close
    (the target is then the present configuration), and once afterwards.

    Args:
        context: The robot, the task, the objects and their grasps.
        wait: Time at the waiting pose (s); default: the time in `config`.
        config: Constants of the method.

    Attributes:
        config: Constants of the method.
    """

    name = "yang2021"
    control_period = 0.1

    def __init__(self, context: PolicyContext, wait: float | None = None, config: YangConfig | None = None) -> None:
        super().__init__(context)
        self.config = config or YangConfig()
        if wait is not None:
            self.config = replace(self.config, wait_time=milliseconds_from_wait(wait) / 1000.0)
        self._ik_solver: IkSolver | None = None
        self._library = GraspLibrary(context.grasps, context.object_names)
        self._start_episode()

    def _start_episode(self) -> None:
        self._phase, self._close_until = YangPhase.WAIT, 0.0
        # World poses (2, 7) of the hand link at the selected standoff and grasp, and the last
        # selected standoff, near which the next one has a low cost.
        self._selected: Array | None = None
        self._reference: Array | None = None
        self._retreat: Action | None = None

    def prepare(self, object_names: Sequence[str]) -> None:
        """Read the grasps of the object that is handed over."""
        self._library.get_gripper_poses(object_names[0])

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; the receiver is deterministic."""
        if self._ik_solver is None:
            # Loaded here so that it does not count as planning time.
            self._ik_solver = make_ik_solver(self.context.panda_urdf, self.context.panda)
        self._start_episode()

    @property
    def wait(self) -> float:
        """Time at the waiting pose (s)."""
        return self.config.wait_time

    @property
    def planned_goal(self) -> Array | None:
        """(2, 7) world poses of the hand link at standoff and grasp; None once fingers close."""
        return self._selected if self._phase is YangPhase.APPROACH else None

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s), infinite during the retreat."""
        if self._phase is YangPhase.WAIT:
            return self.config.wait_time or self.config.decision_period
        if self._phase is YangPhase.APPROACH:
            return self.config.decision_period
        return 0.001 if self._phase is YangPhase.CLOSE else float("inf")

    def act(self, observation: Observation) -> Action:
        """Return the next nine target joint positions.

        Raises:
            ResetNeededError: `reset` was not called.
        """
        time = round(float(observation["time"][0]), 3)
        if time < self.config.wait_time:
            return np.array(panda.WAITING_JOINTS, dtype=np.float32)
        if self._phase is YangPhase.WAIT:
            self._phase = YangPhase.APPROACH
        if self._phase is YangPhase.APPROACH:
            hand, selected = observation["gripper_pose"], self._selected
            if selected is None or not self._is_in_region(hand, *selected):
                return _make_action(self._move_to_standoff(observation), panda.OPEN)
            if not self._is_at_grasp(hand, selected[1]):
                return _make_action(self._move_to_grasp(observation, selected[1]), panda.OPEN)
            self._phase = YangPhase.CLOSE
            self._close_until = round(time + self.config.close_time, 3)
        if self._phase is YangPhase.CLOSE and time < self._close_until:
            return _make_action(_arm_joints(observation), panda.CLOSED)
        if self._retreat is None:
            self._phase = YangPhase.RETREAT
            self._retreat = _make_action(self._goal_joints(observation), panda.CLOSED)
        return self._retreat

    def _move_to_standoff(self, observation: Observation) -> npt.NDArray[np.floating]:
        """Select the cheapest reachable standoff and return its arm joints."""
        grasps = self._library.get_hand_poses_in_world(observation)
        if grasps is None:
            return _arm_joints(observation)
        standoffs = compose(grasps, np.array(self.config.standoff))
        solver, joints = require_reset(self._ik_solver, self.name), observation["robot_joint_position"]
        cheapest = np.argsort(self._costs(standoffs, observation["gripper_pose"]), kind="stable")
        for index in cheapest[: self.config.max_candidates]:
            arm = solver.solve(joints, standoffs[index, :3], standoffs[index, 3:])
            if arm is not None:
                self._selected = np.stack([standoffs[index], grasps[index]])
                self._reference = standoffs[index]
                return arm
        self._reference = None
        return _arm_joints(observation)

    def _move_to_grasp(self, observation: Observation, grasp: Array) -> npt.NDArray[np.floating]:
        """Return the arm joints after one step towards the grasp."""
        hand = observation["gripper_pose"][:3]
        offset = grasp[:3] - hand
        distance = float(np.linalg.norm(offset))
        target = grasp.copy()
        if distance >= self.config.step_length:
            # The reference rounds this set-point to float32, like the observed position.
            target[:3] = (hand + offset / distance * self.config.step_length).astype(np.float32)
        solver = require_reset(self._ik_solver, self.name)
        arm = solver.solve(observation["robot_joint_position"], target[:3], target[3:])
        return _arm_joints(observation) if arm is None else arm

    def _goal_joints(self, observation: Observation) -> npt.NDArray[np.floating]:
        """Return the arm joints at the goal."""
        solver = require_reset(self._ik_solver, self.name)
        arm = solver.solve(observation["robot_joint_position"], self.context.protocol.goal_center)
        return _arm_joints(observation) if arm is None else arm

    def _costs(self, standoffs: Array, hand: npt.NDArray[np.float32]) -> Array:
        """Return the costs (n,) of standoffs (n, 7)."""
        reference = hand if self._reference is None else self._reference
        weight = self.config.rotation_weight
        to_preferred = compute_pose_distances(self.config.preferred_pose, standoffs, weight)
        return compute_pose_distances(reference, standoffs, weight) + to_preferred

    def _is_in_region(self, hand: npt.NDArray[np.float32], standoff: Array, grasp: Array) -> bool:
        """Return whether the hand is in the region between standoff and grasp."""
        angle = min(compute_rotation_angle(hand[3:], standoff[3:]), compute_rotation_angle(hand[3:], grasp[3:]))
        axis = grasp[:3] - standoff[:3]
        length = float(np.linalg.norm(axis))
        # The projection is divided by the length twice and clipped in between, as in the reference.
        share = float(np.clip(np.dot(hand[:3] - standoff[:3], axis) / length, 0.0, 1.0)) / length
        distance = float(np.linalg.norm(standoff[:3] + share * axis - hand[:3]))
        config = self.config
        width = config.region_width * (1.0 + config.region_slope * length)
        return distance < min(width, config.region_max_width) and angle < config.angle_tolerance

    def _is_at_grasp(self, hand: npt.NDArray[np.float32], grasp: Array) -> bool:
        is_near = float(np.linalg.norm(grasp[:3] - hand[:3])) < self.config.grasp_tolerance
        return is_near and compute_rotation_angle(hand[3:], grasp[3:]) < self.config.angle_tolerance


def _arm_joints(observation: Observation) -> npt.NDArray[np.float32]:
    return observation["robot_joint_position"][:ARM_DOF]


def _make_action(arm: npt.NDArray[np.floating], fingers: float) -> Action:
    return np.concatenate([arm, [fingers, fingers]]).astype(np.float32)
