"""State machine of a handover (wait, approach, close, back out, retreat), and base class of receivers with it."""

from enum import Enum

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF, TIME_STEP
from handover_marl.geometry.poses import inverse_transform_points, transform_points
from handover_marl.planning.arm_control import ArmInWorld, ArmServo
from handover_marl.policies.policy import Action, PolicyContext, Receiver, milliseconds_from_wait
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.motion import (
    FAILED_DURATION,
    IK_ITERATIONS,
    ROTATION_WEIGHT,
    ApproachController,
    MotionController,
)
from handover_marl.receivers.reactive.retreat import RetreatController
from handover_marl.receivers.reactive.scene_estimate import SceneEstimate
from handover_marl.receivers.reactive.selector import GraspGoal, GraspSelector

Array = npt.NDArray[np.float64]

# Times since the fingers began to close (s): the gripper backs out if the person has not released the object by the
# first time, or if the fingers are closed after the second.
_CLOSE_TIMEOUT, _EMPTY_DELAY = 0.8, 0.35
# Gain with which the gripper follows the person's hand while the fingers close (1/s), and maximum joint acceleration
# (rad/s^2), high enough that the gripper stops before the fingers push the object.
_CLOSE_GAIN, _CLOSE_ACCELERATION = 10.0, 100.0
# Backing out after a missed grasp: distance (m), speed (m/s), maximum time, and time for which the fingers open (s).
_BACKOUT_DISTANCE, _BACKOUT_SPEED, _BACKOUT_TIMEOUT, _OPENING_TIME = 0.1, 0.3, 1.0, 0.1
#: Amount by which joint limits are narrowed on each side (rad).
LIMIT_PADDING = 0.03
_BACKOUT_ROTATION_WEIGHT = 0.3  # m/rad
_BACKOUT_END = 0.3  # share of the distance that may remain at the end


class ReactivePhase(Enum):
    """Phase of a handover by the receiver `reactive`.

    Attributes:
        WAIT: The arm is at its waiting pose, or moves there, until a person offers an object.
        APPROACH: The gripper moves to the standoff of the selected grasp.
        FINAL_APPROACH: The gripper moves from the standoff to the grasp in a straight line.
        CLOSE: The fingers close, until the person releases the object or the grasp has failed.
        BACK_OUT: The gripper backs out after a missed grasp.
        RETREAT: The robot carries the object to the goal.
    """

    WAIT = "wait"
    APPROACH = "approach"
    FINAL_APPROACH = "final approach"
    CLOSE = "close"
    BACK_OUT = "back out"
    RETREAT = "retreat"


class HandoverController:
    """State machine of the receiver `reactive` during one episode.

    Args:
        motion: Controller of the motion; the caller updates `motion.scene`, the scene estimate, before each step.
        selector: Grasp selector; the caller sets its candidates.
        goal: (3,) goal of the hand link's position in the world (m).
        wait: Time at the waiting pose (s).

    Attributes:
        phase: Present phase of the handover.
    """

    def __init__(self, motion: MotionController, selector: GraspSelector, goal: Array, wait: float) -> None:
        self._motion, self._scene, self._selector, self._goal, self._wait = motion, motion.scene, selector, goal, wait
        self._config = motion.scene.config
        self._approach_controller = ApproachController(motion, selector)
        self.phase = ReactivePhase.WAIT
        self._phase_start = 0.0
        self._closing_pose, self._closing_points = np.zeros(7), np.zeros((0, 3))
        self._backout_position = np.zeros(3)
        self._retreat: RetreatController | None = None

    @property
    def is_grasping(self) -> bool:
        """Whether the fingers close or hold the object."""
        return self.phase in (ReactivePhase.CLOSE, ReactivePhase.RETREAT)

    @property
    def planned_goal(self) -> Array | None:
        """(2, 7) world poses (quaternion xyzw) of the hand link at standoff and grasp; None except in the approach."""
        chosen = self._selector.chosen
        if chosen is None or not self._is_approaching:
            return None
        grasp = self._selector.compute_grasp_pose(chosen, self._scene.object_pose)
        return np.stack([self._selector.compute_standoff_pose(grasp), grasp])

    def step(self) -> Action:
        """Return the next action (9,), target joint positions (rad, m); update `phase` and the servo's period."""
        config, servo = self._config, self._motion.servo
        is_watchful = self._is_approaching and self._scene.has_motion_nearby
        servo.period = config.near_period if is_watchful else config.period
        if self._scene.time < self._wait:
            return self._motion.move_home()
        if self.phase is ReactivePhase.WAIT and len(self._selector.grasps) and self._scene.is_offered:
            self.phase = ReactivePhase.APPROACH
        if self._is_approaching:
            return self._approach()
        if self.phase is ReactivePhase.CLOSE:
            return self._close(self._scene.has_released(self._phase_start))
        if self.phase is ReactivePhase.BACK_OUT:
            return self._back_out()
        if self._retreat is not None and self.phase is ReactivePhase.RETREAT:
            return self._carry(self._retreat)
        return self._motion.move_home()

    @property
    def _is_approaching(self) -> bool:
        return self.phase in (ReactivePhase.APPROACH, ReactivePhase.FINAL_APPROACH)

    def _approach(self) -> Action:
        scene = self._scene
        if scene.is_lost:
            return self._motion.search()
        result = self._approach_controller.step()
        if not isinstance(result, GraspGoal):
            self.phase = ReactivePhase.FINAL_APPROACH if self._approach_controller.is_near else ReactivePhase.APPROACH
            return result
        self.phase, self._phase_start = ReactivePhase.CLOSE, scene.time
        self._closing_pose = self._selector.compute_grasp_pose(result, scene.object_pose)
        self._closing_points = scene.person.reference_points
        return self._close(False)

    def _close(self, is_released: bool) -> Action:
        config, scene, motion = self._config.approach, self._scene, self._motion
        if is_released and not scene.is_gripping:
            return self._catch()
        if is_released:
            self.phase = ReactivePhase.RETREAT
            gripper_pose = scene.gripper_pose
            surface = transform_points(scene.object_pose, self._selector.surface.centers)
            held = inverse_transform_points(gripper_pose, surface)
            person, others = scene.person.spheres, scene.obstacles
            self._retreat = RetreatController(
                motion.arm, motion.servo, self._goal, self._config.retreat, gripper_pose, held, person, others
            )
            return self._carry(self._retreat)
        since = scene.time - self._phase_start
        if since > _CLOSE_TIMEOUT or (since > _EMPTY_DELAY and scene.are_fingers_closed):
            return self._start_backing_out()
        # Follows the person's hand rather than the object, which the fingers push.
        period = config.close_period
        motion.servo.period = period
        pose = scene.person.predict_attached_pose(self._closing_points, self._closing_pose, period)
        goal, _ = motion.arm.solve(pose[None], scene.arm_joints[None], IK_ITERATIONS)
        following = motion.arm.compute_joint_velocity(
            scene.arm_joints, scene.person.velocity, np.zeros(3), ROTATION_WEIGHT, period
        )
        velocity = following + _CLOSE_GAIN * (goal[0] - scene.arm_joints)
        return motion.move_closed(velocity, _CLOSE_ACCELERATION)

    def _catch(self) -> Action:
        """Return an action that catches an object released too early, or backs out if the object is out of reach."""
        config, scene, motion = self._config.approach, self._scene, self._motion
        chosen, period = self._selector.chosen, config.close_period
        if chosen is None or not self._approach_controller.is_catchable(chosen):
            return self._start_backing_out()
        motion.servo.period = period
        # The object may spin, which the gripper cannot follow.
        falling, _ = scene.motion.predict_point_twist(scene.object_pose[:3], period)
        velocity = motion.arm.compute_joint_velocity(scene.arm_joints, falling, np.zeros(3), ROTATION_WEIGHT, period)
        return motion.catch(velocity, _CLOSE_ACCELERATION)

    def _start_backing_out(self) -> Action:
        """Return the first action of backing out after a missed grasp, and increase the grasp's cost for a while."""
        scene = self._scene
        self._selector.give_up(scene.time + FAILED_DURATION)
        self.phase, self._phase_start = ReactivePhase.BACK_OUT, scene.time
        self._backout_position = transform_points(scene.gripper_pose, np.array([0.0, 0.0, -_BACKOUT_DISTANCE]))
        return self._back_out()

    def _back_out(self) -> Action:
        scene, motion = self._scene, self._motion
        since = scene.time - self._phase_start
        remaining = self._backout_position - scene.gripper_pose[:3]
        distance = float(np.linalg.norm(remaining))
        if distance < _BACKOUT_END * _BACKOUT_DISTANCE or since > _BACKOUT_TIMEOUT:
            self.phase = ReactivePhase.APPROACH
            return self._approach()
        if since < _OPENING_TIME:
            return motion.move_open(np.zeros(ARM_DOF))
        velocity = _BACKOUT_SPEED * remaining / distance
        period = motion.servo.period
        joint_velocity = motion.arm.compute_joint_velocity(
            scene.arm_joints, velocity, np.zeros(3), _BACKOUT_ROTATION_WEIGHT, period
        )
        return motion.move_open(joint_velocity)

    def _carry(self, retreat: RetreatController) -> Action:
        scene = self._scene
        if scene.has_empty_fingers:
            return self._start_backing_out()
        return self._motion.carry(retreat.compute_velocity(scene.time, scene.arm_joints, scene.gripper_pose))


class ControllerReceiver(Receiver):
    """Base class of receivers that act through a grasp selector and a `HandoverController`.

    Args:
        context: Robot, objects and task.
        wait: Time at the waiting pose (s).
        config: Configuration of grasp selection and motion.

    Attributes:
        arm: Kinematics of the arm.
        servo: Controller that converts joint velocities to motor targets.
        selector: Grasp selector.
        controller: Controller of the present episode; None before the first `reset`.
    """

    def __init__(self, context: PolicyContext, wait: float, config: ReactiveConfig) -> None:
        super().__init__(context)
        self.config = config
        self._wait = milliseconds_from_wait(wait) / 1000.0
        self.arm = ArmInWorld.for_panda(context.panda_urdf, context.panda, LIMIT_PADDING)
        self.servo = ArmServo(config.servo, context.panda.motor.position_gain, config.period, TIME_STEP)
        self.selector = GraspSelector(self.arm, self.servo.max_speeds, config)
        self.controller: HandoverController | None = None

    @property
    def wait(self) -> float:
        """Time at the waiting pose (s)."""
        return self._wait

    @property
    def planned_goal(self) -> Array | None:
        """(2, 7) world poses (quaternion xyzw) of the hand link at standoff and grasp; None except in the approach."""
        return None if self.controller is None else self.controller.planned_goal

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s), shorter near a moving object or hand and while the fingers close."""
        return self.servo.period

    def start_episode(self, scene: SceneEstimate) -> None:
        """Reset selector and servo, and create the `controller` of an episode, which reads the estimate `scene`."""
        self.servo.reset()
        self.selector.reset()
        motion, goal = MotionController(self.arm, self.servo, scene), np.array(self.context.protocol.goal_center)
        self.controller = HandoverController(motion, self.selector, goal, self._wait)
