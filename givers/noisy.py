"""People whose hand is not steady."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.giver import Giver, deviation
from handover_marl.policies.policy import Action


class NoisyGiver(Giver):
    """Sways about the recorded path, and hurries and dawdles a little.

    An Ornstein-Uhlenbeck process: deviations wander and are drawn back, with the standard deviations below.
    """

    name = "noisy"
    displacement = 0.02  # m, standard deviation along each axis
    rotation = 0.1  # rad, of each component
    rate = 0.15
    memory = 0.5  # s

    def reset(self, seed: int | None = None) -> None:
        """Draw anew; starts as recorded."""
        self._rng = np.random.default_rng(seed)
        self._sway = np.zeros(7)

    def act(self, observation: Observation) -> Action:
        """Sway."""
        spread = np.array([self.rate, *[self.displacement] * 3, *[self.rotation] * 3])
        kept = np.exp(-self.control_period / self.memory)
        self._sway = kept * self._sway + np.sqrt(1.0 - kept**2) * spread * self._rng.standard_normal(7)
        return deviation(self._sway[0], self._sway[1:4], self._sway[4:])
