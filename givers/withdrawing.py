"""Giver that withdraws the hand from a robot that approaches fast."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, make_giver_action


class WithdrawingGiver(Giver):
    """Giver that withdraws the hand while the gripper approaches fast, as a stress test.

    Attributes:
        max_speed: Speed of the gripper towards the wrist above which the hand withdraws (m/s).
        max_distance: Distance from gripper to wrist beyond which the hand does not withdraw (m).
        withdrawal: Distance by which the hand withdraws (m).
        return_after: Time after which the hand returns, unless the gripper approaches fast (s).
    """

    name = "withdrawing"
    max_speed = 0.25
    max_distance = 0.45
    withdrawal = 0.15
    return_after = 0.8

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without deviation from the recording."""
        self._last_distance: float | None = None
        self._until = -1.0
        self._displacement = np.zeros(3)

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that withdraws the hand, or the one that follows the recording."""
        now = float(observation["time"][0])
        away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
        distance = float(np.linalg.norm(away))
        last = self._last_distance
        speed = 0.0 if last is None else (last - distance) / self.control_period
        self._last_distance = distance
        present = bool(observation["hand_present"][0])
        if present and distance < self.max_distance and speed > self.max_speed:
            self._until = now + self.return_after
            self._displacement = self.withdrawal * away / max(distance, 1e-6)
        return make_giver_action(displacement=self._displacement if now < self._until else np.zeros(3))
