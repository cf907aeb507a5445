"""Givers that replay the recorded motion at another speed, or with pauses."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, make_giver_action

# Playback rate minus 1 of a paused recording, and of one at the recorded speed.
_PAUSE, _NORMAL = -1.0, 0.0


class HesitantGiver(Giver):
    """Giver that pauses the recorded motion at random times.

    Attributes:
        pauses_per_second: Mean number of pauses that start in a second without a pause.
        shortest_pause: Smallest duration of a pause (s).
        longest_pause: Largest duration of a pause (s).
    """

    name = "hesitant"
    pauses_per_second = 0.6
    shortest_pause, longest_pause = 0.3, 1.0

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without a pause; the seed determines the times of later pauses."""
        self._rng = np.random.default_rng(seed)
        self._until = 0.0

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that pauses, or the one that replays at the recorded speed."""
        now = float(observation["time"][0])
        if now >= self._until and self._rng.random() < self.pauses_per_second * self.control_period:
            self._until = now + self._rng.uniform(self.shortest_pause, self.longest_pause)
        return make_giver_action(rate=_PAUSE if now < self._until else _NORMAL)


class HurriedGiver(Giver):
    """Giver that replays the recorded motion faster, at a random speed per episode.

    Attributes:
        min_rate: Smallest playback rate minus 1.
        max_rate: Largest playback rate minus 1.
    """

    name = "hurried"
    min_rate, max_rate = 0.4, 1.0

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with a random playback speed."""
        self._rate = float(np.random.default_rng(seed).uniform(self.min_rate, self.max_rate))

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that replays the recording at the speed drawn for this episode."""
        return make_giver_action(rate=self._rate)


class StopWhenNearGiver(Giver):
    """Giver that pauses the recording while the gripper is near the object.

    GenH2R has such a giver (Wang et al., CVPR 2024).

    Attributes:
        distance: Distance from the Panda's hand link to the object's origin below which the
            recording pauses (m).
    """

    name = "stop_when_near"
    distance = 0.35

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; this giver keeps no state."""

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that pauses, or the one that replays at the recorded speed."""
        distance = np.linalg.norm(observation["gripper_pose"][:3] - observation["object_poses"][0, :3])
        return make_giver_action(rate=_PAUSE if distance < self.distance else _NORMAL)
