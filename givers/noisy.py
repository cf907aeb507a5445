"""Giver with random deviations from the recording."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, make_giver_action


class NoisyGiver(Giver):
    """Giver with Ornstein-Uhlenbeck noise on playback rate, wrist position and wrist rotation.

    Attributes:
        displacement: Standard deviation of each component of the wrist's displacement (m).
        rotation: Standard deviation of each component of the wrist's rotation vector (rad).
        rate: Standard deviation of the playback rate.
        time_constant: Correlation time of the noise (s).
    """

    name = "noisy"
    displacement = 0.02
    rotation = 0.1
    rate = 0.15
    time_constant = 0.5

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without deviation."""
        self._rng = np.random.default_rng(seed)
        self._deviation = np.zeros(7)

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) with the next random deviation from the recording."""
        deviations = np.array([self.rate, *[self.displacement] * 3, *[self.rotation] * 3])
        decay = np.exp(-self.control_period / self.time_constant)
        noise = self._rng.standard_normal(7)
        self._deviation = decay * self._deviation + np.sqrt(1.0 - decay**2) * deviations * noise
        return make_giver_action(self._deviation[0], self._deviation[1:4], self._deviation[4:])
