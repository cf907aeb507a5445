"""Prediction of the pose at which a person will hold out an object, from the object's motion until now."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, bounded

Array = npt.NDArray[np.float64]

_TIME_TOLERANCE = 1e-6  # s


@dataclass(frozen=True)
class HandoverPosePredictorConfig(CheckedConfig):
    """Constants of the motion model that predicts where an object is handed over.

    The remaining translation of an object at position p with velocity v is predicted as

        velocity_horizon * v
        + attraction * tanh(|v| / attraction_speed) * (mean_handover_position - p).

    The second term moves the prediction of a moving object towards the mean handover position; it is zero for an object
    at rest. An object counts as held still if it was lifted and is near where it was `held_still_time` ago. Then its
    latest velocity is extrapolated for a shorter time, without the second term. The constants were fitted on s0 train.

    Attributes:
        velocity_horizon: Time for which the velocity is extrapolated (s).
        attraction: Predicted translation of a fast object as a share of its distance from `mean_handover_position`.
        attraction_speed: Speed scale of the second term (m/s); the term is smaller for slower objects.
        mean_handover_position: Mean position of objects when they are held out, world frame (m).
        rotation_horizon: Time for which the angular velocity is extrapolated (s).
        smoothing_time: Time constant of the velocity filter (s).
        rest_speed: Speed below which an object counts as at rest (m/s).
        held_still_radius: Largest distance of a still object from its position `held_still_time` ago (m).
        held_still_time: Time between the two positions by which an object counts as held still (s).
        held_still_min_lift: Smallest distance of a still object, `held_still_time` ago, from its first position (m).
        held_still_horizon: Time for which the latest velocities of a still object are extrapolated (s).
    """

    velocity_horizon: float = bounded(0.21, 0.0)
    attraction: float = bounded(0.61, 0.0, 1.0)
    attraction_speed: float = bounded(0.3, 1e-6)
    mean_handover_position: tuple[float, float, float] = (0.577, 0.139, 1.239)
    rotation_horizon: float = bounded(0.1, 0.0)
    smoothing_time: float = bounded(0.05, 1e-6)
    rest_speed: float = bounded(0.05, 0.0)
    held_still_radius: float = bounded(0.08, 0.0)
    held_still_time: float = bounded(0.6, 0.0)
    held_still_min_lift: float = bounded(0.1, 0.0)
    held_still_horizon: float = bounded(0.05, 0.0)


class HandoverPosePredictor:
    """Predictor of the pose at which an object will be handed over, from its motion in an episode.

    Args:
        config: Constants of the motion model.

    Attributes:
        velocity: (3,) filtered velocity of the object in the world (m/s).
        angular_velocity: (3,) filtered angular velocity of the object in the world (rad/s).
        latest_velocity: (3,) world velocity between the last two updates, not filtered (m/s).
        latest_angular_velocity: (3,) world angular velocity between the last two updates, not filtered (rad/s).
        acceleration: (3,) rate of change of `latest_velocity` (m/s^2).
        rest_time: Time for which the object has been at rest (s).
        start: (3,) position of the object at the first update (m), None before that update.
    """

    def __init__(self, config: HandoverPosePredictorConfig) -> None:
        self.config = config
        self.velocity, self.angular_velocity, self.rest_time = np.zeros(3), np.zeros(3), 0.0
        self.latest_velocity, self.latest_angular_velocity = np.zeros(3), np.zeros(3)
        self.acceleration = np.zeros(3)
        self.start: Array | None = None
        self._step = np.inf
        self._time, self._pose = 0.0, np.zeros(7)
        self._history: deque[tuple[float, Array]] = deque()

    def update(self, time: float, pose: Array) -> None:
        """Update the estimated motion from the object's world pose (7,) (quaternion xyzw) at a time (s)."""
        if self.start is None:
            self.start = pose[:3].copy()
        elif time > self._time:
            self._update_velocities(time - self._time, pose)
        self._time, self._pose = time, pose.copy()
        self._history.append((time, self._pose[:3]))
        oldest = time - self.config.held_still_time + _TIME_TOLERANCE
        while len(self._history) > 1 and self._history[1][0] < oldest:
            self._history.popleft()

    def _update_velocities(self, step: float, pose: Array) -> None:
        """Update velocities, acceleration and rest time after a time step (s) to a new pose (7,)."""
        kept = float(np.exp(-step / self.config.smoothing_time))
        rotation = (Rotation.from_quat(pose[3:]) * Rotation.from_quat(self._pose[3:]).inv()).as_rotvec()
        before = self.latest_velocity
        self.latest_velocity = (pose[:3] - self._pose[:3]) / step
        self.latest_angular_velocity = rotation / step
        self.acceleration = (self.latest_velocity - before) / (0.5 * (step + self._step))
        self._step = step
        self.velocity = kept * self.velocity + (1.0 - kept) * self.latest_velocity
        self.angular_velocity = kept * self.angular_velocity + (1.0 - kept) * self.latest_angular_velocity
        self.rest_time = self.rest_time + step if self.speed < self.config.rest_speed else 0.0

    @property
    def is_held_still(self) -> bool:
        """Whether the object was lifted and is near its position `config.held_still_time` ago."""
        if self.start is None:
            return False
        config, (since, position) = self.config, self._history[0]
        lift, distance = (float(np.linalg.norm(position - other)) for other in (self.start, self._pose[:3]))
        is_long_enough = self._time - since > config.held_still_time - _TIME_TOLERANCE
        return is_long_enough and lift > config.held_still_min_lift and distance < config.held_still_radius

    @property
    def speed(self) -> float:
        """Speed of the object, from its filtered velocity (m/s)."""
        return float(np.linalg.norm(self.velocity))

    @property
    def lift_distance(self) -> float:
        """Distance of the object from its first position, in any direction (m)."""
        return 0.0 if self.start is None else float(np.linalg.norm(self._pose[:3] - self.start))

    def predict_handover_pose(self) -> Array:
        """Return the world pose (7,) (quaternion xyzw) at which the object is expected to be held out."""
        config = self.config
        if self.is_held_still:
            return self.extrapolate_pose(config.held_still_horizon)
        attraction = config.attraction * np.tanh(self.speed / config.attraction_speed)
        to_mean = np.array(config.mean_handover_position) - self._pose[:3]
        position = self._pose[:3] + config.velocity_horizon * self.velocity + attraction * to_mean
        return np.concatenate([position, self._rotated(config.rotation_horizon * self.angular_velocity)])

    def extrapolate_pose(self, ahead: float) -> Array:
        """Return the object's world pose (7,) (quaternion xyzw) after a time `ahead` (s) at its latest velocity."""
        position = self._pose[:3] + ahead * self.latest_velocity
        return np.concatenate([position, self._rotated(ahead * self.latest_angular_velocity)])

    def predict_point_twist(self, point: Array, ahead: float) -> tuple[Array, Array]:
        """Predict the velocities, linear (3,) in m/s and angular (3,) in rad/s, of a world point (3,) on the object.

        They hold for the middle of the coming control period, which lasts `ahead` (s). The object's linear velocity is
        extrapolated to it at constant acceleration; the angular velocity is assumed to stay constant.
        """
        since = 0.5 * (self._step + ahead) if np.isfinite(self._step) else 0.0
        velocity = self.latest_velocity + since * self.acceleration
        angular = self.latest_angular_velocity
        return velocity + np.cross(angular, point - self._pose[:3]), angular

    def _rotated(self, rotation: Array) -> Array:
        """Return the object's orientation (quaternion xyzw), rotated by a rotation vector (3,) in the world (rad)."""
        return np.asarray((Rotation.from_rotvec(rotation) * Rotation.from_quat(self._pose[3:])).as_quat())
