"""Estimated state of robot, object and person's hand, used by the receivers `reactive` and `vision`."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.geometry.poses import compose, invert_pose, transform_points
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.hand_tracker import HandTracker
from handover_marl.planning.handover_prediction import HandoverPosePredictor
from handover_marl.planning.robot_clearance import Spheres
from handover_marl.receivers.reactive.config import ReactiveConfig

Array = npt.NDArray[np.float64]

# Factor on tolerances of the approach for a held object that moves slowly.
_HELD_STILL_TOLERANCE_FACTOR = 2.0
# Maximum closing speed of fingers that the object blocks, as a share of their position per second (1/s).
_MAX_GRIP_CLOSING_RATE = 3.0
# Speed of the object relative to the person's hand (m/s) above which the gripper seems to push the object.
_MAX_RELATIVE_SPEED = 0.25
# Distance of the object from the hand link below which it is near (m), and speed above which something moves (m/s).
_NEAR_DISTANCE, _NEAR_SPEED = 0.3, 0.1
# Time at rest after which an object counts as settled (s). An object that was not lifted counts as offered after the
# second time at rest beside a still hand, but not before the third; without a hand, after the fourth (s).
_SETTLE_TIME, _STILL_TIME, _STILL_START, _NO_HAND_START = 0.2, 0.6, 1.5, 3.0
# Maximum distance from the object to the nearest keypoint of a hand beside it, and from the base to obstacles (m).
_HAND_DISTANCE, _OBSTACLE_REACH = 0.15, 1.1
# Smallest divisor of the closing speed, and finger position below which the fingers hold nothing (m).
_MIN_OPENING, _EMPTY_FINGER_POSITION = 1e-4, 0.0015


class SceneEstimate(ABC):
    """Estimate of the states of robot, object and person's hand in an episode; subclasses track object and hand.

    Args:
        arm: Kinematics of the arm.
        config: Configuration of the receiver.
        person: Tracker of the person's hand.

    Attributes:
        time: Time since the start of the episode (s).
        arm_joints: (7,) configuration of the arm (rad).
        fingers: (2,) positions of the fingers (m).
        gripper_pose: (7,) world pose of the robot's hand link, quaternion xyzw.
        object_pose: (7,) world pose of the object that is handed over, quaternion xyzw.
        motion: Predictor of the handover pose from the object's motion.
        obstacles: Spheres in the world that approximate the other objects within reach; None if there are none.
    """

    def __init__(self, arm: ArmInWorld, config: ReactiveConfig, person: HandTracker) -> None:
        self._arm, self.config = arm, config
        self.obstacles: Spheres | None = None
        self.time = 0.0
        self.arm_joints, self.fingers = np.zeros(ARM_DOF), np.zeros(2)
        self.gripper_pose = self.object_pose = np.zeros(7)
        self.motion, self.person = HandoverPosePredictor(config.prediction), person

    def update_robot(self, observation: Observation) -> None:
        """Update time, joints and hand link pose of the robot from an observation, but neither object nor hand."""
        joints = observation["robot_joint_position"].astype(np.float64)
        self.time = round(float(observation["time"][0]), 3)
        self.arm_joints, self.fingers = joints[:ARM_DOF], joints[ARM_DOF:]
        self.gripper_pose = self._arm.compute_hand_pose(self.arm_joints)

    def set_obstacles(self, spheres: Spheres) -> None:
        """Set `obstacles` to the spheres (world frame) with centers within reach of the arm, None if there are none."""
        reachable = spheres.select_within(self._arm.base[:3], _OBSTACLE_REACH)
        self.obstacles = reachable if len(reachable.radii) else None

    @abstractmethod
    def has_released(self, closing_since: float) -> bool:
        """Return whether the person has released the object; the fingers began to close at `closing_since` (s).

        The receiver calls this method once in every decision while the fingers close.
        """

    def predict_point_twist(self, point: Array, ahead: float) -> tuple[Array, Array]:
        """Predict linear (m/s) and angular velocity (rad/s), world frame, of a world point (3,) fixed to the object.

        The linear velocity is extrapolated to the middle of the coming control period, which lasts `ahead` (s).
        """
        return self.motion.predict_point_twist(point, ahead)

    def predict_bodies(self, handover_pose: Array, surface: Spheres) -> Spheres:
        """Return spheres in the world: of object and person's hand at the handover pose, and of other objects.

        `handover_pose` (7,) is the object's world pose (quaternion xyzw) there; `surface` is in the object's frame.
        """
        human_hand = self.person.spheres
        bodies = [Spheres(transform_points(handover_pose, surface.centers), surface.radii)]
        if human_hand is not None:
            moved = transform_points(compose(handover_pose, invert_pose(self.object_pose)), human_hand.centers)
            bodies.append(Spheres(moved, human_hand.radii))
        return Spheres.join(bodies if self.obstacles is None else [*bodies, self.obstacles])

    def plan_search(self) -> Array:
        """Return the configuration (7,) in rad to which the arm moves while no grasp is suitable: the waiting pose."""
        return np.array(WAITING_JOINTS[:ARM_DOF])

    @property
    def hand_in_object(self) -> Spheres | None:
        """Spheres that approximate the person's hand, in the object's frame, or None if there is no hand."""
        human_hand = self.person.spheres
        return None if human_hand is None else human_hand.transform_to_frame(self.object_pose)

    @property
    def is_known_released(self) -> bool:
        """Whether the person is known to have released the object; False unless a subclass observes the release."""
        return False

    @property
    def is_gripping(self) -> bool:
        """Whether the object seems to block the closing fingers; True unless a subclass measures the fingers."""
        return True

    @property
    def is_lost(self) -> bool:
        """Whether the object has been out of sight for too long and must be searched for."""
        return False

    @property
    def are_fingers_closed(self) -> bool:
        """Whether the fingers are closed so far that no object is between them."""
        return float(self.fingers.max()) < _EMPTY_FINGER_POSITION

    @property
    def has_empty_fingers(self) -> bool:
        """Whether the fingers are known to have closed with nothing between them."""
        return False

    @property
    def is_offered(self) -> bool:
        """Whether the object was lifted or rests beside a still hand; without a hand, whether 3 s have passed."""
        config, person = self.config, self.person
        if person.spheres is None:
            return self.time > _NO_HAND_START
        if self.motion.lift_distance > config.min_lift:
            return True
        is_near = person.compute_distance(self.object_pose[:3]) < _HAND_DISTANCE
        is_beside = is_near and person.speed < config.prediction.rest_speed
        return is_beside and self.motion.rest_time > _STILL_TIME and self.time > _STILL_START

    @property
    def is_settled(self) -> bool:
        """Whether the object is at rest, or is held almost still in the air."""
        return self.motion.rest_time > _SETTLE_TIME or self.motion.is_held_still

    @property
    def has_motion_nearby(self) -> bool:
        """Whether the object is near the gripper and the object or the person's hand moves."""
        distance = float(np.linalg.norm(self.object_pose[:3] - self.gripper_pose[:3]))
        is_near = distance < _NEAR_DISTANCE
        return is_near and max(self.motion.speed, self.person.speed) > _NEAR_SPEED

    @property
    def tolerance_factor(self) -> float:
        """Factor on tolerances of the approach: 2 for an object that is held almost still, but not at rest, else 1."""
        is_moving = self.motion.is_held_still and self.motion.rest_time == 0.0
        return _HELD_STILL_TOLERANCE_FACTOR if is_moving else 1.0


class PoseSceneEstimate(SceneEstimate):
    """Estimate of the scene that uses the true poses of object and person's hand.

    Args:
        arm: Kinematics of the arm.
        config: Configuration of the receiver.
        load_obstacle: Function of a class name that returns spheres at the object's surface, in the object's frame.
        object_names: Class name of each class number in observations.

    Attributes:
        object_name: Class of the object that is handed over.
    """

    def __init__(
        self,
        arm: ArmInWorld,
        config: ReactiveConfig,
        load_obstacle: Callable[[str], Spheres],
        object_names: Mapping[int, str] = CLASS_NAMES,
    ) -> None:
        super().__init__(arm, config, HandTracker())
        self._load_obstacle, self._object_names = load_obstacle, object_names
        self.object_name = ""
        self._is_released = False
        self._closing_rate = 0.0

    def update(self, observation: Observation) -> None:
        """Update robot, object and person's hand from an observation."""
        time, fingers = self.time, self.fingers
        self.update_robot(observation)
        if self.time > time:
            closed = float((fingers - self.fingers).max()) / max(float(fingers.max()), _MIN_OPENING)
            self._closing_rate = closed / (self.time - time)
        self.object_pose = observation["object_poses"][0].astype(np.float64)
        self.object_name = self._object_names[int(observation["object_classes"][0])]
        self._is_released = bool(observation["released"][0])
        self.motion.update(self.time, self.object_pose)
        self.person.update(self.time, observation)
        self._update_obstacles(observation)

    def has_released(self, closing_since: float) -> bool:
        """Return whether the person has released the object, as observed; `closing_since` is not used."""
        return self._is_released

    def predict_point_twist(self, point: Array, ahead: float) -> tuple[Array, Array]:
        """Predict the twist of a point on the object, or on the person's hand if the gripper pushes the object."""
        relative = self.motion.latest_velocity - self.person.velocity
        is_held = self.person.spheres is not None and not self._is_released
        if is_held and float(np.linalg.norm(relative)) > _MAX_RELATIVE_SPEED:
            # To follow the pushed object would push it on.
            return self.person.velocity, np.zeros(3)
        return super().predict_point_twist(point, ahead)

    @property
    def is_known_released(self) -> bool:
        """Whether the person has released the object, as observed."""
        return self._is_released

    @property
    def is_gripping(self) -> bool:
        """Whether the fingers have nearly stopped: the object is between them, or they are closed."""
        return self._closing_rate < _MAX_GRIP_CLOSING_RATE

    def _update_obstacles(self, observation: Observation) -> None:
        """Set `obstacles` to all objects but the first one, which is handed over, at their observed poses."""
        others = np.flatnonzero(observation["object_mask"][1:]) + 1
        if not len(others):
            return
        bodies = []
        for number in others:
            surface = self._load_obstacle(self._object_names[int(observation["object_classes"][number])])
            pose = observation["object_poses"][number].astype(np.float64)
            bodies.append(Spheres(transform_points(pose, surface.centers), surface.radii))
        self.set_obstacles(Spheres.join(bodies))
