"""A receiver that does anything: what learning has to beat."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import receiver_action_space
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver


class RandomReceiver(Receiver):
    """Draws target joint positions within the limits, all alike likely, ten times a second."""

    name = "random"

    def reset(self, seed: int | None = None) -> None:
        """Draw anew."""
        self._rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Action:
        """Anything."""
        space = receiver_action_space()
        return self._rng.uniform(space.low, space.high).astype(np.float32)
