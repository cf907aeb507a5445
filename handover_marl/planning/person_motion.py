"""A person's hand as balls that move."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.planning.capsules import hand_capsules
from handover_marl.planning.gripper_room import Balls, balls_of

Array = npt.NDArray[np.float64]

_PER_CAPSULE = 3
_WRIST, _INDEX, _LITTLE = 0, 1, 7
# The heel of the hand is wider than the capsules that meet in it (m).
_HEEL_WIDTH, _HEEL_RADIUS = 0.02, 0.016
_SMOOTHING = 0.02  # s


class HandMotion:
    """Follows a hand through an episode.

    Attributes:
        balls: The hand in the world, or None if there is none.
        points: (k, 3) its keypoints (m).
        velocity: (3,) of their middle (m/s).
    """

    def __init__(self) -> None:
        self.balls: Balls | None = None
        self.velocity = np.zeros(3)
        self._time, self.points = 0.0, np.zeros((0, 3))

    def see(self, time: float, observation: Observation) -> None:
        """Take note of an observation made at a time (s)."""
        capsules = hand_capsules(observation)
        if capsules is None:
            self.balls, self.velocity, self.points = None, np.zeros(3), np.zeros((0, 3))
            return
        points = observation["hand_keypoints"].astype(np.float64)
        if len(self.points) and time > self._time:
            step = time - self._time
            kept = float(np.exp(-step / _SMOOTHING))
            moved = (points - self.points).mean(axis=0) / step
            self.velocity = kept * self.velocity + (1.0 - kept) * moved
        self._time, self.points = time, points
        body = balls_of(capsules, _PER_CAPSULE)
        across = points[_INDEX] - points[_LITTLE]
        across = _HEEL_WIDTH * across / max(float(np.linalg.norm(across)), 1e-6)
        heel = points[_WRIST] + np.array([-1.0, 0.0, 1.0])[:, None] * across
        self.balls = Balls(np.concatenate([body.centers, heel]), np.append(body.radii, np.full(3, _HEEL_RADIUS)))

    def moved(self, points: Array, pose: Array, ahead: float) -> Array:
        """Where a pose (7,) that is fixed to the hand has come to.

        Args:
            points: (k, 3) the hand's keypoints when it was there.
            pose: It.
            ahead: For so long from now (s).
        """
        if points.shape != self.points.shape or not len(points):
            return pose
        before, after = points.mean(axis=0), self.points.mean(axis=0)
        turn, _ = Rotation.align_vectors(self.points - after, points - before)
        place = after + turn.apply(pose[:3] - before) + ahead * self.velocity
        return np.concatenate([place, (turn * Rotation.from_quat(pose[3:])).as_quat()])

    @property
    def anchor(self) -> Array:
        """(k, 3) what tells where the hand is, for `moved` (m)."""
        return self.points

    @property
    def speed(self) -> float:
        """Of the hand (m/s)."""
        return float(np.linalg.norm(self.velocity))

    def distance(self, place: Array) -> float:
        """From a place (3,) to the nearest joint of the hand (m)."""
        return float(np.linalg.norm(self.points - place, axis=1).min()) if len(self.points) else np.inf
