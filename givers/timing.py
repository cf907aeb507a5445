"""People who keep to the recorded path but not to its time."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.giver import Giver, deviation
from handover_marl.policies.policy import Action

_PAUSE, _STEADY = -1.0, 0.0


class HesitantGiver(Giver):
    """Stops now and then on the way, as somebody who is not sure whether the robot is ready."""

    name = "hesitant"
    pauses_per_second = 0.6
    shortest, longest = 0.3, 1.0  # s

    def reset(self, seed: int | None = None) -> None:
        """Draw anew when to stop."""
        self._rng = np.random.default_rng(seed)
        self._until = 0.0

    def act(self, observation: Observation) -> Action:
        """Pause or go on."""
        now = float(observation["time"][0])
        if now >= self._until and self._rng.random() < self.pauses_per_second * self.control_period:
            self._until = now + self._rng.uniform(self.shortest, self.longest)
        return deviation(rate=_PAUSE if now < self._until else _STEADY)


class HurriedGiver(Giver):
    """Moves faster than recorded, as somebody who wants to get it over with."""

    name = "hurried"
    slowest, fastest = 0.4, 1.0  # playback rate beyond the recorded one

    def reset(self, seed: int | None = None) -> None:
        """Draw how much of a hurry it is."""
        self._rate = float(np.random.default_rng(seed).uniform(self.slowest, self.fastest))

    def act(self, observation: Observation) -> Action:
        """Go on, fast."""
        return deviation(rate=self._rate)


class StopWhenNearGiver(Giver):
    """Freezes while the gripper is near the object, as GenH2R's people do, so that it is taken at rest."""

    name = "stop_when_near"
    distance = 0.35  # m, from the gripper's hand link to the object's origin

    def reset(self, seed: int | None = None) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """Freeze or go on."""
        gap = np.linalg.norm(observation["gripper_pose"][:3] - observation["object_poses"][0, :3])
        return deviation(rate=_PAUSE if gap < self.distance else _STEADY)
