"""Motion of the receiver `reactive`: actions that keep clearances, and the approach to the grasp."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from handover_marl.config import TABLE_HEIGHT, TIME_STEP
from handover_marl.geometry.panda import CLOSED, OPEN
from handover_marl.geometry.poses import IDENTITY, compose, transform_points
from handover_marl.geometry.rotations import compute_rotation_angles
from handover_marl.planning.arm_control import ArmInWorld, ArmServo
from handover_marl.planning.collision_avoidance import (
    MovingBody,
    SeparationConfig,
    enforce_separation,
    select_safe_velocity,
)
from handover_marl.planning.robot_clearance import Spheres
from handover_marl.policies.policy import Action
from handover_marl.receivers.reactive.scene_estimate import SceneEstimate
from handover_marl.receivers.reactive.selector import HOME, GraspGoal, GraspSelector

Array = npt.NDArray[np.float64]

IK_ITERATIONS = 8
#: Weight of rotations relative to translations where the arm follows a moving object (m/rad).
ROTATION_WEIGHT = 0.1
# Region before a grasp in which the gripper moves straight to the grasp: maximum axial distance beyond the standoff,
# lateral distance (m) and rotation error (rad). Axial distances are along the gripper's approach axis.
_STRAIGHT_MARGIN, _STRAIGHT_LATERAL, _STRAIGHT_ROTATION = 0.05, 0.06, 0.5
# Region around the selected grasp in which no other is selected: axial and lateral distance (m), rotation error (rad).
# Within half of this axial distance and the last, lateral distance (m), the gripper does not go back to align itself.
_COMMIT_DISTANCE, _COMMIT_LATERAL, _COMMIT_ROTATION, _ENCLOSED_LATERAL = 0.06, 0.03, 0.3, 0.015
# Increase of the lateral (1) and rotation tolerances (rad/m) per meter of axial distance from the grasp.
_LATERAL_FUNNEL, _ROTATION_FUNNEL = 0.3, 1.0
# Gain on the remaining joint error (1/s), maximum joint speed that it causes (rad/s), and maximum change of the seed of
# inverse kinematics from the present configuration towards the selected one (rad).
_POSITION_GAIN, _MAX_JOINT_SPEED, _MAX_POSTURE_CHANGE = 20.0, 1.3, 0.05
# Axial distance from the grasp at which the fingers close (m), and deceleration before the grasp (m/s^2).
_AXIAL_TOLERANCE, _DECELERATION = 0.006, 2.0
# Distance from the grasp within which the fingers close around an object that the person has released already (m).
_CATCH_DISTANCE = 0.02
# Time without progress after which a grasp is given up (s).
_STALL_TIMEOUT = 0.8
#: Time for which a failed grasp has a higher cost (s).
FAILED_DURATION = 4.0
# The remaining distance must fall below this share of its last value to count as progress.
_PROGRESS_RATIO = 0.95
# Speed factors that are tried where the full speed would violate a clearance.
_SPEED_FACTORS = np.array([1.0, 0.6, 0.35, 0.2, 0.1, 0.05, 0.0])


class MotionController:
    """Controller that converts joint velocities to actions (9,) that keep clear of the person's hand and of objects.

    Joint velocities (7,) (rad/s) that methods take are wanted ones. They are changed to keep clear of bodies, unless a
    method ignores these, and limited to the servo's speeds and accelerations.

    Args:
        arm: Kinematics of the arm.
        servo: Controller that converts joint velocities to motor targets.
        scene: Estimate of the scene.
    """

    def __init__(self, arm: ArmInWorld, servo: ArmServo, scene: SceneEstimate) -> None:
        self.arm, self.servo, self.scene, self._config = arm, servo, scene, scene.config.separation

    def move_home(self) -> Action:
        """Return the action towards the robot's waiting pose, ignoring person and objects."""
        return self.move_open(self.servo.compute_goal_velocity(self.scene.arm_joints, HOME))

    def search(self) -> Action:
        """Return the action towards the configuration of `SceneEstimate.plan_search`, clear of hand and obstacles."""
        velocity = self.servo.compute_goal_velocity(self.scene.arm_joints, self.scene.plan_search())
        return self.move_open(self._separate(velocity, self._config.hand_clearance))

    def move_to(self, goal: Array, surface: Spheres) -> Action:
        """Return the action towards the joints `goal` (7,) (rad) that keeps clear of person and objects.

        `surface` approximates the object that is handed over, in the frame of this object.
        """
        velocity = self.servo.limit_speed(self.servo.compute_goal_velocity(self.scene.arm_joints, goal))
        return self.move_open(self._separate(velocity, self._config.hand_clearance, surface=surface))

    def approach(self, velocity: Array) -> Action:
        """Return the action of the final approach with joint velocities (7,) (rad/s), clear of the person's hand.

        The fingers are open. The clearances to the person's hand and to other objects are smaller than on the way to
        the standoff, and the gripper may touch the object to grasp.
        """
        config = replace(
            self._config,
            time_constant=self._config.approach_time_constant,
            obstacle_clearance=self._config.grasp_obstacle_clearance,
        )
        return self.move_open(self._separate(velocity, config.grasp_hand_clearance, config))

    def carry(self, velocity: Array) -> Action:
        """Return the action with joint velocities (7,) (rad/s) and closed fingers, clear of the person's hand."""
        velocity = self.servo.limit_speed(velocity)
        return self.move_closed(self._separate(velocity, self._config.hand_clearance, leaving=True))

    def catch(self, velocity: Array, acceleration: float) -> Action:
        """Return the action that closes the fingers around a falling object; `acceleration` is as in `move_closed`."""
        return self.move_closed(self._separate(velocity, self._config.grasp_hand_clearance), acceleration)

    def move_open(self, velocity: Array) -> Action:
        """Return the action with joint velocities (7,) (rad/s) and open fingers, ignoring obstacles."""
        return self._make_action(velocity, OPEN, None)

    def move_closed(self, velocity: Array, acceleration: float | None = None) -> Action:
        """Return the action with joint velocities (7,) (rad/s) and closing fingers, ignoring obstacles.

        `acceleration` (rad/s^2), unless None, replaces the configured maximum joint acceleration.
        """
        return self._make_action(velocity, CLOSED, acceleration)

    def _make_action(self, velocity: Array, fingers: float, acceleration: float | None) -> Action:
        target = self.servo.compute_motor_targets(self.scene.arm_joints, self.servo.limit_speed(velocity), acceleration)
        return np.array([*target, fingers, fingers], dtype=np.float32)

    def _separate(
        self,
        velocity: Array,
        clearance: float,
        config: SeparationConfig | None = None,
        surface: Spheres | None = None,
        leaving: bool = False,
    ) -> Array:
        """Return joint velocities (7,) (rad/s) near `velocity` that keep as clear as possible of person and objects.

        Args:
            velocity: Wanted joint velocities (7,) (rad/s).
            clearance: Minimum clearance to the person's hand (m).
            config: Other clearances; default: the configuration of the receiver.
            surface: Surface of the object to keep clear of, in its frame; default: ignore the object.
            leaving: Whether it suffices, as in a retreat, not to come closer to bodies that are too close already.
        """
        scene, bodies, config = self.scene, list[MovingBody](), config or self._config
        if surface is not None:
            moved = Spheres(transform_points(scene.object_pose, surface.centers), surface.radii)
            bodies.append(MovingBody(moved, scene.motion.latest_velocity, config.object_clearance))
        if scene.obstacles is not None:
            bodies.append(MovingBody(scene.obstacles, np.zeros(3), config.obstacle_clearance))
        if scene.person.spheres is not None:
            bodies.append(MovingBody(scene.person.spheres, scene.person.velocity, clearance))
        separated = enforce_separation(velocity, self.arm, scene.arm_joints, bodies, config, leaving)
        candidates = _SPEED_FACTORS[:, None] * self.servo.limit_speed(separated)
        reached = self.servo.limit_acceleration(candidates)
        return select_safe_velocity(candidates, reached, self.arm, scene.arm_joints, bodies, TABLE_HEIGHT, config)


class ApproachController:
    """Controller of the approach to the selected grasp, until the fingers may close.

    Args:
        motion: Controller that converts joint velocities to actions.
        selector: Grasp selector.

    Attributes:
        is_near: Whether the gripper is near enough to move straight to the grasp.
    """

    def __init__(self, motion: MotionController, selector: GraspSelector) -> None:
        self._scene, self._motion, self._selector = motion.scene, motion, selector
        self._config, self._period = motion.scene.config.approach, motion.scene.config.period
        self.is_near = False
        self._selected_at = -np.inf
        self._remaining, self._remaining_at = np.inf, 0.0
        self._last_position, self._last_position_at = np.zeros(3), -np.inf

    def step(self) -> Action | GraspGoal:
        """Return the next action, or the grasp if the fingers can close now; without a suitable grasp, search."""
        goal = self._select_goal()
        if goal is None:
            self.is_near = False
            return self._motion.search()
        config, scene = self._config, self._scene
        error = self._selector.compute_pose_in_grasp(goal, scene.object_pose, scene.gripper_pose)
        factor = scene.tolerance_factor
        # The fingers close along y and center what is between them, which tolerates more error there.
        axial, lateral, rotation = -float(error[2]), float(np.hypot(error[0], error[1] / factor)), _compute_angle(error)
        max_lateral = _STRAIGHT_LATERAL if axial > _COMMIT_DISTANCE else _COMMIT_LATERAL
        is_in_front = axial < config.standoff + _STRAIGHT_MARGIN and lateral < max_lateral
        self.is_near = is_in_front and rotation < _STRAIGHT_ROTATION
        if not self.is_near:
            self._check_progress(float(np.abs(goal.standoff_joints - scene.arm_joints).max()))
            waypoint = goal.standoff_joints if goal.via_joints is None else goal.via_joints
            return self._motion.move_to(waypoint, self._selector.surface)
        self._check_progress(axial + lateral)
        is_at_grasp = abs(axial) < factor * _AXIAL_TOLERANCE and lateral < factor * config.lateral_tolerance
        if scene.is_known_released:
            # The object falls: only fingers that are around it already can catch it.
            return goal if self.is_catchable(goal) else self._approach_straight(goal, 0.0)
        is_slow = self._compute_object_speed(error[:3]) < factor * config.close_speed
        if is_slow and is_at_grasp and rotation < factor * config.rotation_tolerance:
            return goal
        return self._approach_straight(goal, self._compute_next_depth(axial, lateral, rotation))

    def is_catchable(self, goal: GraspGoal) -> bool:
        """Return whether the gripper is within 2 cm of a grasp, near enough to catch a falling object."""
        error = self._selector.compute_pose_in_grasp(goal, self._scene.object_pose, self._scene.gripper_pose)
        return float(np.linalg.norm(error[:3])) < _CATCH_DISTANCE

    def _compute_object_speed(self, position: Array) -> float:
        """Return the object's speed (m/s): relative to the gripper if `tolerance_factor` is 2, else in the world.

        The gripper is now at `position` (3,) in the grasp's frame (m).
        """
        scene, before = self._scene, self._last_position
        since = scene.time - self._last_position_at
        self._last_position, self._last_position_at = position, scene.time
        if scene.tolerance_factor > 1.0 and 0.0 < since < 2.0 * self._period:
            return float(np.linalg.norm(position - before)) / since
        return scene.motion.speed

    def _select_goal(self) -> GraspGoal | None:
        """Return the grasp to approach, or None; select again every control period until the gripper is close to it."""
        scene, chosen = self._scene, self._selector.chosen
        if chosen is not None:
            error = self._selector.compute_pose_in_grasp(chosen, scene.object_pose, scene.gripper_pose)
            lateral = float(np.hypot(error[0], error[1]))
            is_close = -error[2] < _COMMIT_DISTANCE and lateral < _COMMIT_LATERAL
            if is_close and _compute_angle(error) < _COMMIT_ROTATION:
                return chosen
        if scene.time - self._selected_at < self._period - TIME_STEP:
            return chosen
        self._selected_at = scene.time
        goal = self._selector.select(scene, self.is_near)
        if goal is None or chosen is None or goal.number != chosen.number:
            self._remaining, self._remaining_at = np.inf, scene.time
        return goal

    def _compute_next_depth(self, axial: float, lateral: float, rotation: float) -> float:
        """Return the next axial distance (m) from a grasp, given the axial, lateral (m) and rotation errors (rad) now.

        It decreases while the gripper is aligned and the object is slow; else the gripper waits or goes back.
        """
        config, motion, factor = self._config, self._scene.motion, self._scene.tolerance_factor
        before, speed = max(axial, 0.0), motion.speed
        is_aligned = lateral < factor * (config.lateral_tolerance + _LATERAL_FUNNEL * before)
        is_aligned &= rotation < factor * (config.rotation_tolerance + _ROTATION_FUNNEL * before)
        if is_aligned and speed < (config.max_held_still_speed if motion.is_held_still else config.max_object_speed):
            period = self._motion.servo.period
            half = 0.5 * _DECELERATION * period
            braking_speed = float(np.sqrt(half**2 + 2.0 * _DECELERATION * before)) - half
            return max(0.0, before - min(config.speed, braking_speed) * period)
        if is_aligned and axial < config.standoff and speed < 2.0 * config.max_object_speed:
            return before
        is_enclosed = axial < 0.5 * _COMMIT_DISTANCE and lateral < _ENCLOSED_LATERAL
        return axial if is_enclosed and factor == 1.0 else config.standoff

    def _approach_straight(self, goal: GraspGoal, depth: float) -> Action:
        """Return the action towards the axial distance `depth` (m) from a grasp of the moving object."""
        config, scene, arm = self._config, self._scene, self._motion.arm
        back = np.array([0.0, 0.0, -depth, 0.0, 0.0, 0.0, 1.0])
        pose = compose(self._selector.compute_grasp_pose(goal, scene.object_pose), back)
        # The seed is the present configuration, moved slightly towards the selected one: without this, joint limits may
        # be in the way, and a larger motion at once would swing the hand link aside.
        share = depth / config.standoff
        change = goal.grasp_joints + share * (goal.standoff_joints - goal.grasp_joints) - scene.arm_joints
        scale = _MAX_POSTURE_CHANGE / max(float(np.abs(change).max()), _MAX_POSTURE_CHANGE)
        joints, _ = arm.solve(pose[None], (scene.arm_joints + scale * change)[None], IK_ITERATIONS)
        velocity = _POSITION_GAIN * (joints[0] - scene.arm_joints)
        velocity *= min(1.0, _MAX_JOINT_SPEED / max(float(np.abs(velocity).max()), 1e-9))
        period = self._motion.servo.period
        linear, angular = scene.predict_point_twist(pose[:3], period)
        following = arm.compute_joint_velocity(scene.arm_joints, linear, angular, ROTATION_WEIGHT, period)
        return self._motion.approach(velocity + following)

    def _check_progress(self, remaining: float) -> None:
        """Give up the grasp if the remaining distance (m or rad) to it has not decreased for too long."""
        time = self._scene.time
        if remaining < _PROGRESS_RATIO * self._remaining or not self._scene.is_settled:
            self._remaining, self._remaining_at = remaining, time
        elif time - self._remaining_at > _STALL_TIMEOUT:
            self._selector.give_up(time + FAILED_DURATION)


def _compute_angle(pose: Array) -> float:
    """Return the rotation angle (rad) of a pose (7,)."""
    return float(compute_rotation_angles(pose[3:], IDENTITY[3:]))
