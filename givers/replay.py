"""The recorded person: no deviation at all."""

import numpy as np

from handover_marl.givers.base import Action, Giver
from handover_marl.observations import Observation
from handover_marl.spaces import GIVER_ACTION_SIZE


class ReplayGiver(Giver):
    """Replays the recording, as HandoverSim does."""

    name = "replay"

    def reset(self, seed: int | None = None) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """No deviation."""
        return np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)
