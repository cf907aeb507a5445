"""The expert in the place of the network, in GA-DDPG's protocol as it is deployed: what imitation can reach at best."""

from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS
from handover_marl.episode.observations import ALL, Observation
from handover_marl.imitation.gaddpg.expert import Expert, ExpertConfig
from handover_marl.imitation.gaddpg.grasp_book import GraspBook, PriceConfig, way_prices
from handover_marl.imitation.gaddpg.kinematic_arm import KinematicArm
from handover_marl.models.poses import compose, inverse
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.receivers.gaddpg import GaddpgReceiver

Array = npt.NDArray[np.float64]


class ExpertReceiver(GaddpgReceiver):
    """Knows the object's true pose, and nothing of the person's hand.

    Goals are chosen at the first decision, and again once the object has moved by `again` (m), which takes long.

    Args:
        context: The robot and the objects.
        wait: How long to stay at the start pose (s).
        again: Goals are chosen again after so much of a way (m).
        config: How goals are chosen.
        prices: What grasps cost.
    """

    name = "gaddpg_expert"
    observes = ALL

    def __init__(
        self,
        context: PolicyContext,
        wait: float | None = None,
        again: float = 0.1,
        config: ExpertConfig | None = None,
        prices: PriceConfig | None = None,
    ) -> None:
        super().__init__(context, network=self._step, wait=wait)
        self._config, self._again = config or ExpertConfig(), again
        self._arm = KinematicArm(context)
        book = GraspBook(context, prices or PriceConfig())
        self._expert = Expert(context, book, self._arm, self._config)
        self._goals: tuple[Array, Array] | None = None
        self._chosen_at, self._seen = np.zeros(3), dict[str, Any]()

    def reset(self, seed: int | None = None) -> None:
        """Forget the episode."""
        super().reset(seed)
        self._goals = None

    def act(self, observation: Observation) -> Action:
        """As the receiver it is."""
        self._seen = observation
        return super().act(observation)

    def _step(self, points: Array, remaining: int) -> Array:
        pose = self._seen["object_poses"][0].astype(np.float64)
        hand = self._seen["gripper_pose"].astype(np.float64)
        if self._goals is None or np.linalg.norm(pose[:3] - self._chosen_at) > self._again:
            joints = self._seen["robot_joint_position"][:ARM_JOINTS].astype(np.float64)
            name = CLASS_NAMES[int(self._seen["object_classes"][0])]
            goals, prices = self._expert.goals(name, pose, joints, np.zeros(4))
            if len(goals):
                self._goals, self._chosen_at = (compose(inverse(pose), goals), prices), pose[:3]
        if self._goals is None:
            return np.zeros(6)
        goals = compose(pose, self._goals[0])
        number = int(np.argmin(self._goals[1] + way_prices(hand, goals, 0.1, 0.15)))
        return self._expert.step(hand, goals[number], remaining)
