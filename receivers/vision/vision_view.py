"""What the vision receiver sees now, from points alone."""

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.person_motion import HandMotion
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig
from handover_marl.receivers.reactive.reactive_view import View
from handover_marl.receivers.vision.percept import Percept

Array = npt.NDArray[np.float64]


class SeenHand(HandMotion):
    """A person's hand as far as its points are seen; it is taken to move with the object and not to turn.

    The middle of what is seen of it moves with the camera, too, and tells less.
    """

    def __init__(self) -> None:
        super().__init__()
        self._place: Array | None = None

    def follow(self, percept: Percept) -> None:
        """Take over what was seen."""
        self.balls = percept.hand
        self.points = np.zeros((0, 3)) if percept.hand is None else percept.hand.centers
        self.velocity = percept.velocity
        self._place = percept.object.place

    def moved(self, points: Array, pose: Array, ahead: float) -> Array:
        """Where a pose (7,) that moves with the hand has come to.

        Args:
            points: (1, 3) where the hand was when it was there, or none.
            pose: It.
            ahead: For so long from now (s).
        """
        if not len(points) or self._place is None:
            return pose
        return np.concatenate([pose[:3] + self._place - points[0] + ahead * self.velocity, pose[3:]])

    @property
    def anchor(self) -> Array:
        """(1, 3) where it is, or (0, 3)."""
        return np.zeros((0, 3)) if self._place is None else self._place[None].copy()


class VisionView(View):
    """Follows one episode by points.

    Args:
        arm: The arm.
        config: All constants of the receiver.
        percept: What makes grasps of points.
    """

    def __init__(self, arm: ArmInWorld, config: ReactiveConfig, percept: Percept) -> None:
        super().__init__(arm, config)
        self.person: SeenHand = SeenHand()
        self._percept = percept

    def see(self, observation: Observation) -> None:
        """Take note of an observation."""
        self.feel(observation)
        counts = observation["wrist_point_counts"].astype(int)
        item, hand = (
            observation[key][:count].astype(np.float64)
            for key, count in zip(("wrist_object_points", "wrist_hand_points"), counts, strict=True)
        )
        self._percept.see(self.time, self.hand, item, hand)
        self.person.follow(self._percept)
        if self._percept.seen:
            self.object = self._percept.object_pose
            self.offer.see(self.time, self.object)

    @property
    def offered(self) -> bool:
        """Whether the person hands the object over, as far as is seen."""
        # Of a hand behind the object nothing is seen; what was lifted is in it all the same.
        return self._percept.seen and (self.offer.lifted > self._config.lifted or super().offered)
