"""Estimated state of robot, object and person's hand from point clouds, used by the receiver `vision`."""

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.poses import transform_points
from handover_marl.grasps.graspable_object import OBSTACLE_RADIUS
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.hand_tracker import HandTracker
from handover_marl.planning.robot_clearance import Spheres
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.scene_estimate import SceneEstimate
from handover_marl.receivers.vision.grasp_tracker import LOST_TIMEOUT, GraspTracker, LabelVotes, VoxelMap
from handover_marl.receivers.vision.mask_predictor import MaskPredictor, segment_clouds
from handover_marl.receivers.vision.view_planner import ViewPlanner

Array = npt.NDArray[np.float64]

#: Times out of sight after which the camera searches for the object (s). The second is for an object that was at rest
#: when it was last visible: the camera may look away while the arm moves to a grasp, or around other objects.
SEARCH_TIMEOUT, HIDDEN_TIMEOUT = 0.25, 1.5
# Edge length of the voxels in which views vote on predicted labels (m), and memory of these votes (s).
_VOTE_VOXEL_SIZE, _VOTE_MEMORY = 0.02, 0.5
#: Edge length of the voxels that each keep one point of the other objects (m).
OBSTACLE_VOXEL_SIZE = 0.025
# Finger motion between two decisions below which the fingers are at rest (m). If the fingers are not fully closed, the
# person seems to have released the object after the first time at rest, or the second since they began to close (s).
_FINGER_REST_DISTANCE, _RELEASE_DELAY, _RELEASE_TIMEOUT = 0.0004, 0.15, 0.5


class PointCloudHandTracker(HandTracker):
    """Tracker of a person's hand, which is assumed to move with the object without rotation.

    The center of the hand's visible part is not used, since it also changes when the camera moves.
    """

    def __init__(self) -> None:
        super().__init__()
        self._object_position: Array | None = None

    def update_from_tracker(self, tracker: GraspTracker) -> None:
        """Update points and velocity of the person's hand from the tracker of the object."""
        self.spheres = tracker.human_hand
        self.points = np.zeros((0, 3)) if tracker.human_hand is None else tracker.human_hand.centers
        self.velocity = tracker.velocity
        self._object_position = tracker.position.position if tracker.position.is_known else None

    def predict_attached_pose(self, points: Array, pose: Array, ahead: float) -> Array:
        """Return the world pose (7,), `ahead` (s) from now, of a frame that moves with the person's hand.

        The frame was at the world pose `pose` (7,) (quaternion xyzw) when `reference_points` were `points`. Without an
        object position then or now, `pose` is returned.
        """
        if not len(points) or self._object_position is None:
            return pose
        position = pose[:3] + self._object_position - points[0] + ahead * self.velocity
        return np.concatenate([position, pose[3:]])

    @property
    def reference_points(self) -> Array:
        """(1, 3) world position of the object (m), or (0, 3) before its first view."""
        return np.zeros((0, 3)) if self._object_position is None else self._object_position[None].copy()


class PointCloudSceneEstimate(SceneEstimate):
    """Estimate of the scene from the point clouds of the wrist camera.

    Args:
        arm: Kinematics of the arm.
        config: Configuration of grasp selection and motion.
        tracker: Tracker of object, hand and grasps.
        view_planner: Planner of the views from which the camera looks at object and hand.
        predict_masks: Predictor of the segmentation masks; None: observations have segmented point clouds.
    """

    def __init__(
        self,
        arm: ArmInWorld,
        config: ReactiveConfig,
        tracker: GraspTracker,
        view_planner: ViewPlanner,
        predict_masks: MaskPredictor | None = None,
    ) -> None:
        self._person = PointCloudHandTracker()
        super().__init__(arm, config, self._person)
        self.tracker, self._view_planner, self._predict_masks = tracker, view_planner, predict_masks
        self._last_fingers = np.zeros(2)
        self._closing_since, self._moved_at = -np.inf, np.inf
        self._search_timeout = SEARCH_TIMEOUT
        self._obstacle_map = VoxelMap(OBSTACLE_VOXEL_SIZE, np.inf)
        self._votes = LabelVotes(_VOTE_VOXEL_SIZE, _VOTE_MEMORY)

    def update(self, observation: Observation) -> None:
        """Update robot, object and person's hand from an observation."""
        self.update_robot(observation)
        if self._predict_masks is not None:
            observation = segment_clouds(observation, self.gripper_pose, self._predict_masks)
        counts = observation["wrist_point_counts"].astype(int)
        object_points, hand_points, others = (
            observation[f"wrist_{name}_points"][:count].astype(np.float64)
            for name, count in zip(("object", "hand", "other"), counts, strict=True)
        )
        if self._predict_masks is not None:
            object_points, hand_points = self._vote(object_points, hand_points)
        self.tracker.update(self.time, self.gripper_pose, object_points, hand_points)
        self._person.update_from_tracker(self.tracker)
        if self.tracker.position.is_known:
            self.object_pose = self.tracker.object_pose
            self.motion.update(self.time, self.object_pose)
        if self.tracker.compute_unseen_time(self.time) == 0.0:
            self._set_lost_timeouts()
        if len(others):
            self._update_obstacles(others)

    def _vote(self, object_points: Array, hand_points: Array) -> tuple[Array, Array]:
        """Return points (n, 3) of object and human hand in the gripper's frame, relabeled by votes of recent views."""
        points, position = np.concatenate([object_points, hand_points]), self.tracker.position
        if not len(points) or not position.is_known:
            return object_points, hand_points
        relative = transform_points(self.gripper_pose, points) - position.predict(self.time)
        is_hand = self._votes.update(self.time, relative, np.arange(len(points)) >= len(object_points))
        return points[~is_hand], points[is_hand]

    def has_released(self, closing_since: float) -> bool:
        """Return whether the person seems to have released the object; fingers began to close at `closing_since` (s).

        This is so once the fingers, not fully closed, have been at rest for 0.15 s, or began to close 0.5 s ago.
        """
        if closing_since != self._closing_since:
            self._closing_since = self._moved_at = closing_since
        moved = float(np.abs(self.fingers - self._last_fingers).max())
        self._last_fingers = self.fingers
        if moved > _FINGER_REST_DISTANCE or self.has_empty_fingers:
            self._moved_at = self.time
        is_late = self.time - closing_since > _RELEASE_TIMEOUT
        return (is_late and not self.are_fingers_closed) or self.time - self._moved_at > _RELEASE_DELAY

    def _set_lost_timeouts(self) -> None:
        """Set how long the object may be out of sight: longer if it is at rest, so that the arm can reach a grasp."""
        is_settled = self.is_settled
        self._search_timeout = HIDDEN_TIMEOUT if is_settled else SEARCH_TIMEOUT
        self.tracker.lost_timeout = HIDDEN_TIMEOUT if is_settled else LOST_TIMEOUT

    def _update_obstacles(self, points: Array) -> None:
        """Add visible points (n, 3) of the other objects, in the hand link's frame (m); these objects do not move."""
        self._obstacle_map.update(self.time, transform_points(self.gripper_pose, points), forget=False)
        centers = self._obstacle_map.points
        self.set_obstacles(Spheres(centers, np.full(len(centers), OBSTACLE_RADIUS)))

    def plan_search(self) -> Array:
        """Return the configuration (7,) in rad of a near view of object and hand; the waiting pose before any view."""
        if not self.tracker.position.is_known:
            return super().plan_search()
        human_hand = self._person.spheres
        target = self.object_pose[:3]
        if self.is_lost and human_hand is not None:
            target = np.median(human_hand.centers, axis=0)
        bodies = self.predict_bodies(self.object_pose, self.tracker.surface)
        return self._view_planner.plan(self.time, self.arm_joints, target, bodies, self.is_settled)

    @property
    def is_lost(self) -> bool:
        """Whether the object has been out of sight for too long and must be searched for."""
        return self.tracker.compute_unseen_time(self.time) > self._search_timeout

    @property
    def has_empty_fingers(self) -> bool:
        """Whether the fingers are fully closed: the person kept the object, or the fingers lost it."""
        return self.are_fingers_closed

    @property
    def is_offered(self) -> bool:
        """Whether the object has been visible, and was lifted or is offered by the rule of the base class."""
        # A hand behind the object is not visible, but it holds an object that was lifted.
        is_lifted = self.motion.lift_distance > self.config.min_lift
        return self.tracker.position.is_known and (is_lifted or super().is_offered)
