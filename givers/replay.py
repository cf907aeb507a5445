"""The recorded person: no deviation at all."""

from handover_marl.givers.base import Action, Giver, deviation
from handover_marl.observations import Observation


class ReplayGiver(Giver):
    """Replays the recording, as HandoverSim does."""

    name = "replay"

    def reset(self, seed: int | None = None) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """No deviation."""
        return deviation()
