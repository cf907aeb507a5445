"""Giver that replays the recording."""

import math

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions


class ReplayGiver(ArrayGiver):
    """Giver that replays the recording without deviation, as in HandoverSim."""

    name = "replay"

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s): infinite, since the action never changes."""
        return math.inf

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode; this giver keeps no state."""

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that follow the recordings without deviation."""
        return self.make_actions(rows)
