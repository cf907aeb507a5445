"""People who do not trust the robot."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.giver import Giver, deviation
from handover_marl.policies.policy import Action


class WithdrawingGiver(Giver):
    """Pulls back when the gripper comes fast and near, and returns when it has calmed down: a stress test."""

    name = "withdrawing"
    alarming_speed = 0.25  # m/s, of the gripper towards the hand
    alarming_distance = 0.45  # m, from gripper to wrist
    retreat = 0.15  # m
    calm_after = 0.8  # s

    def reset(self, seed: int | None = None) -> None:
        """Forget the last fright."""
        self._last_gap: float | None = None
        self._until = -1.0
        self._away = np.zeros(3)

    def act(self, observation: Observation) -> Action:
        """Offer as recorded, or pull back."""
        now = float(observation["time"][0])
        away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
        gap = float(np.linalg.norm(away))
        closing = 0.0 if self._last_gap is None else (self._last_gap - gap) / self.control_period
        self._last_gap = gap
        present = bool(observation["hand_present"][0])
        if present and gap < self.alarming_distance and closing > self.alarming_speed:
            self._until = now + self.calm_after
            self._away = self.retreat * away / max(gap, 1e-6)
        return deviation(displacement=self._away if now < self._until else np.zeros(3))
