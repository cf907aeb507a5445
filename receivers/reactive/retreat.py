"""Retreat with the grasped object: straight out of the person's hand, then to the goal."""

import itertools

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import SHOULDER_HEIGHT
from handover_marl.geometry.poses import IDENTITY, inverse_transform_points, transform_points
from handover_marl.geometry.rotations import rotate_points
from handover_marl.planning.arm_control import ArmInWorld, ArmServo
from handover_marl.planning.robot_clearance import (
    Spheres,
    compute_arm_clearances,
    compute_grasp_clearances,
    compute_open_gripper_clearances,
)
from handover_marl.receivers.reactive.config import RetreatConfig
from handover_marl.receivers.reactive.selector import HOME, IK_SEEDS

Array = npt.NDArray[np.float64]

_DIRECTIONS = np.array(
    [np.array(axes) / np.linalg.norm(axes) for axes in itertools.product((-1, 0, 1), repeat=3) if any(axes)]
)
# End poses are tried with these shares of the rotation to the waiting pose.
_ROTATION_SHARES = (0.0, 0.25, 0.5, 1.0)
# Shares of the path at which clearances are checked.
_CHECKED_SHARES = np.array([0.35, 0.7, 1.0])
# Shares of the path at which clearances to other objects are checked; these may be narrow.
_OBSTACLE_SHARES = np.linspace(0.1, 1.0, 10)
# Length of the straight path out of the person's hand (m); the motion turns gradually towards the goal on it. Maximum
# distance of the hand link's final position from the goal (m).
_BACKOUT_DISTANCE, _GOAL_RADIUS = 0.05, 0.12
#: Desired clearance to the person's hand on the path to the goal (m).
DESIRED_CLEARANCE = 0.02
# Gain (1/s) and weight (m/rad) of rotations on the straight path out of the hand, and maximum time on this path (s).
_ROTATION_GAIN, _ROTATION_WEIGHT, _BACKOUT_TIMEOUT = 2.0, 0.1, 0.4
# Number of final configurations whose paths are checked, and minimum joint difference of a new final configuration from
# all previous ones (rad).
_MAX_PATH_CHECKS, _MIN_JOINT_DIFFERENCE = 40, 0.5
# Time without progress after which another final configuration is selected (s), and joint error at which one is reached
# (rad). The remaining joint error must fall below this share of its last value to count as progress.
_STALL_TIMEOUT, _JOINT_TOLERANCE, _PROGRESS_RATIO = 0.6, 0.05, 0.95
# Radii of base column, upper arm and forearm, around the lines between base, shoulder, elbow and wrist (m).
_LINK_RADII = np.array([0.1, 0.09, 0.075])
_SPHERES_PER_LINK = 6
_SHOULDER, _ELBOW, _WRIST = 1, 3, 4
_IK_ITERATIONS, _IK_TOLERANCE = 12, 5e-3
_UNREACHABLE = 1000.0  # s


class RetreatController:
    """Controller of the arm on one retreat with the grasped object to the goal.

    Args:
        arm: Kinematics of the arm.
        servo: Servo of the arm, with speed limits and control period.
        goal: (3,) goal of the hand link's position in the world (m).
        config: Configuration of the retreat.
        start: (7,) world pose (quaternion xyzw) of the hand link at the start of the retreat.
        held: (k, 3) points of the object in the hand link's frame (m).
        person: Spheres that approximate the person's hand in the world, or None if there is no hand.
        obstacles: Spheres that approximate the other objects in the world, or None if there are none.
    """

    def __init__(
        self,
        arm: ArmInWorld,
        servo: ArmServo,
        goal: Array,
        config: RetreatConfig,
        start: Array,
        held: Array,
        person: Spheres | None,
        obstacles: Spheres | None = None,
    ) -> None:
        self._arm, self._servo, self._goal, self._config = arm, servo, goal, config
        self._start, self._held, self._person, self._obstacles = start, held, person, obstacles
        self._back = -rotate_points(start[3:], np.array([0.0, 0.0, 1.0]))
        self._blend, self._speed = 0.0, 0.0
        self._end: Array | None = None
        self._rejected: list[Array] = []
        self._remaining, self._remaining_at = np.inf, 0.0
        self._started_at: float | None = None

    def compute_velocity(self, time: float, joints: Array, gripper_pose: Array) -> Array:
        """Return the joint velocities (7,) in rad/s of the next control period, at a time (s) of the episode.

        The arm is at joints (7,) (rad); `gripper_pose` (7,) is the hand link's world pose (quaternion xyzw).
        """
        if self._end is None or self._is_stalled(time, float(np.abs(joints - self._end).max())):
            if self._end is not None:
                self._rejected.append(self._end)
            self._end, self._remaining, self._remaining_at = self._select_end(joints, gripper_pose), np.inf, time
        config, period = self._config, self._servo.period
        self._started_at = time if self._started_at is None else self._started_at
        distance = float((gripper_pose[:3] - self._start[:3]) @ self._back)
        progress = max(distance / _BACKOUT_DISTANCE, (time - self._started_at) / _BACKOUT_TIMEOUT)
        self._blend = float(np.clip(progress, self._blend, 1.0))
        self._speed = min(config.speed, self._speed + config.acceleration * period)
        to_end = self._servo.limit_speed(self._servo.compute_goal_velocity(joints, self._end))
        if self._blend >= 1.0:
            return to_end
        rotation = (Rotation.from_quat(self._start[3:]) * Rotation.from_quat(gripper_pose[3:]).inv()).as_rotvec()
        linear, angular = self._speed * self._back, _ROTATION_GAIN * rotation
        out = self._arm.compute_joint_velocity(joints, linear, angular, _ROTATION_WEIGHT, period)
        return np.asarray((1.0 - self._blend) * out + self._blend * to_end)

    def _is_stalled(self, time: float, remaining: float) -> bool:
        if remaining < _PROGRESS_RATIO * self._remaining or remaining < _JOINT_TOLERANCE:
            self._remaining, self._remaining_at = remaining, time
        return time - self._remaining_at > _STALL_TIMEOUT

    def _select_end(self, joints: Array, gripper_pose: Array) -> Array:
        """Return a configuration (7,) (rad) with the hand link near the goal, and a clear and short joint path to it.

        The path must be clear of the arm itself; if none is, the fastest of all is chosen. Paths clear of other objects
        are preferred, then those clear of the person's hand, then the fastest.
        """
        ends, times = self._solve_ends(joints, gripper_pose)
        order = np.argsort(times, kind="stable")
        fastest = order[:_MAX_PATH_CHECKS]
        clear = [n for n in fastest if times[n] < 0.5 * _UNREACHABLE and self._is_clear_of_arm(joints, ends[n])]
        beside = [n for n in clear if self._is_clear_of_obstacles(joints, ends[n])] or clear
        for number in beside:
            if self._is_clear_of_person(joints, ends[number]):
                return np.asarray(ends[number])
        return np.asarray(ends[beside[0] if beside else order[0]])

    def _solve_ends(self, joints: Array, gripper_pose: Array) -> tuple[Array, Array]:
        """Return configurations (n, 7) near the goal (rad), and travel times (n,) in s, over 500 if not to be used."""
        here = Rotation.from_quat(gripper_pose[3:])
        home = (Rotation.from_quat(self._arm.compute_hand_pose(HOME)[3:]) * here.inv()).as_rotvec()
        rotations = [(Rotation.from_rotvec(share * home) * here).as_quat() for share in _ROTATION_SHARES]
        positions = self._goal + _GOAL_RADIUS * np.concatenate([np.zeros((1, 3)), _DIRECTIONS])
        poses = np.array([[*position, *rotation] for position in positions for rotation in rotations])
        seeds = np.concatenate([joints[None], IK_SEEDS])
        all_poses, all_seeds = np.tile(poses, (len(seeds), 1)), np.repeat(seeds, len(poses), axis=0)
        ends, is_reached = self._arm.solve(all_poses, all_seeds, _IK_ITERATIONS, _IK_TOLERANCE)
        times = (np.abs(ends - joints) / self._servo.max_speeds).max(axis=1)
        times[~is_reached] = _UNREACHABLE
        for other in self._rejected:
            is_similar = np.abs(ends - other).max(axis=1) < _MIN_JOINT_DIFFERENCE
            times[is_similar] += 0.5 * _UNREACHABLE
        return ends, times

    def _is_clear_of_person(self, joints: Array, goal: Array) -> bool:
        """Return whether the gripper keeps clear of the person's hand between `joints` (7,) and `goal` (7,) in rad.

        The clearance must be larger than `DESIRED_CLEARANCE`, or than the clearance at `joints` if this is smaller.
        """
        if self._person is None:
            return True
        hands = self._arm.compute_hand_poses(joints + np.array([0.0, *_CHECKED_SHARES])[:, None] * (goal - joints))
        clearances = compute_grasp_clearances(hands, self._person)
        return bool(clearances[1:].min() > min(float(clearances[0]), DESIRED_CLEARANCE))

    def _is_clear_of_obstacles(self, joints: Array, goal: Array) -> bool:
        """Return whether arm and held object keep clear of other objects between `joints` (7,) and `goal` (7,)."""
        if self._obstacles is None:
            return True
        line, obstacles = joints + _OBSTACLE_SHARES[:, None] * (goal - joints), self._obstacles
        hands = self._arm.compute_hand_poses(line)
        arm = compute_arm_clearances(self._arm, line, obstacles)
        if min(arm.min(), compute_open_gripper_clearances(hands, obstacles).min()) < 0.0:
            return False
        held = np.concatenate([transform_points(hand, self._held) for hand in hands])
        distances, nearest = cKDTree(obstacles.centers).query(held)
        return bool((distances > obstacles.radii[nearest]).all())

    def _is_clear_of_arm(self, joints: Array, goal: Array) -> bool:
        """Return whether gripper and held object keep clear of the arm itself between `joints` (7,) and `goal` (7,)."""
        line = joints + _CHECKED_SHARES[:, None] * (goal - joints)
        (links, _), hands = self._arm.compute_link_frames(line), self._arm.compute_hand_poses(line)
        shares = np.linspace(0.0, 1.0, _SPHERES_PER_LINK)[:, None, None]
        for origins, hand in zip(links, hands, strict=True):
            base = np.array([*origins[0, :2], origins[0, 2] - SHOULDER_HEIGHT])
            joints_in_world = np.stack([base, origins[_SHOULDER], origins[_ELBOW], origins[_WRIST]])
            starts, ends = joints_in_world[:-1], joints_in_world[1:]
            centers = (starts + shares * (ends - starts)).reshape(-1, 3)
            arm = Spheres(inverse_transform_points(hand, centers), np.tile(_LINK_RADII, _SPHERES_PER_LINK))
            distances = np.linalg.norm(self._held[:, None] - arm.centers, axis=-1) - arm.radii
            if distances.min() < 0.0 or compute_grasp_clearances(IDENTITY[None], arm, flange=False)[0] < 0.0:
                return False
        return True
