"""Receiver `hold`, a baseline that never moves."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Receiver


class HoldReceiver(Receiver):
    """Receiver that stays at the start configuration with open fingers."""

    name = "hold"

    @property
    def wait(self) -> None:
        """Time at the start configuration: None, since the receiver never starts to move."""
        return None

    def reset(self, seed: int | None = None) -> None:
        """Do nothing; the receiver has no state."""

    def act(self, observation: Observation) -> Action:
        """Return the action that keeps the arm at the start configuration."""
        return np.array(self.context.panda.start_joints, dtype=np.float32)
