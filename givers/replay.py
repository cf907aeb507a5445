"""Giver that replays the recording."""

import math

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, make_giver_action


class ReplayGiver(Giver):
    """Giver that replays the recording without deviation, as in HandoverSim."""

    name = "replay"

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s): infinite, since the action never changes."""
        return math.inf

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; this giver keeps no state."""

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that follows the recording without deviation."""
        return make_giver_action()
