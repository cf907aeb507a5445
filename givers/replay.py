"""The recorded person: no deviation at all."""

import math

from handover_marl.episode.observations import Observation
from handover_marl.policies.giver import Giver, deviation
from handover_marl.policies.policy import Action


class ReplayGiver(Giver):
    """Replays the recording, as HandoverSim does."""

    name = "replay"

    @property
    def hold_time(self) -> float:
        """For ever."""
        return math.inf

    def reset(self, seed: int | None = None) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """No deviation."""
        return deviation()
