"""A receiver that waits and never moves: the floor of every comparison."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver


class HoldReceiver(Receiver):
    """Stays at the start pose with open fingers."""

    name = "hold"

    @property
    def wait(self) -> None:
        """It never comes."""
        return None

    def reset(self, seed: int | None = None) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """The start pose."""
        return np.array(self.context.panda.start_joints, dtype=np.float32)
