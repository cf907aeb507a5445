"""What the reactive receiver sees now, and how what it sees moves."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS
from handover_marl.episode.observations import Observation
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.offer_prediction import OfferPrediction
from handover_marl.planning.person_motion import HandMotion
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig

Array = npt.NDArray[np.float64]


class View:
    """Follows one episode.

    Args:
        arm: The arm.
        config: All constants.

    Attributes:
        time: Since the start of the episode (s).
        joints: (7,) where the arm is (rad).
        fingers: (2,) where the fingers are (m).
        hand: (7,) pose of the hand link in the world.
        object: (7,) pose of the object that is handed over in the world.
        object_name: Its class.
        offer: How it moves.
        person: How the person's hand moves.
    """

    def __init__(self, arm: ArmInWorld, config: ReactiveConfig) -> None:
        self._arm, self._config = arm, config
        self.time = 0.0
        self.joints, self.fingers = np.zeros(ARM_JOINTS), np.zeros(2)
        self.hand = self.object = np.zeros(7)
        self.object_name = ""
        self.offer, self.person = OfferPrediction(config.offer), HandMotion()

    def feel(self, observation: Observation) -> None:
        """Take note of the time and of the robot itself."""
        joints = observation["robot_joint_position"].astype(np.float64)
        self.time = round(float(observation["time"][0]), 3)
        self.joints, self.fingers = joints[:ARM_JOINTS], joints[ARM_JOINTS:]
        self.hand = self._arm.hand(self.joints)

    def see(self, observation: Observation) -> None:
        """Take note of an observation."""
        self.feel(observation)
        self.object = observation["object_poses"][0].astype(np.float64)
        self.object_name = CLASS_NAMES[int(observation["object_classes"][0])]
        self.offer.see(self.time, self.object)
        self.person.see(self.time, observation)

    @property
    def offered(self) -> bool:
        """Whether the person hands the object over: it was lifted, or lies still beside a hand that is still."""
        config, offer, person = self._config, self.offer, self.person
        if person.balls is None:
            return self.time > config.alone
        if offer.lifted > config.lifted:
            return True
        beside = person.distance(self.object[:3]) < config.beside and person.speed < config.offer.slow
        return beside and offer.rest > config.still and self.time > config.after

    @property
    def settled(self) -> bool:
        """Whether the object rests, or hovers."""
        return self.offer.rest > self._config.settled or self.offer.hovers

    @property
    def near_motion(self) -> bool:
        """Whether something moves near the gripper."""
        near = float(np.linalg.norm(self.object[:3] - self.hand[:3])) < self._config.near
        return near and max(self.offer.speed, self.person.speed) > self._config.near_speed

    @property
    def looseness(self) -> float:
        """How many times the usual tolerances are enough: one cannot wait for what hovers to rest."""
        return self._config.approach.hover_loose if self.offer.hovers and self.offer.rest == 0.0 else 1.0
