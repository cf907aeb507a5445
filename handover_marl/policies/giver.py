"""What every giver is: a policy that deviates from the replayed human motion."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Policy


def deviation(
    rate: float = 0.0,
    displacement: npt.ArrayLike = (0.0, 0.0, 0.0),
    rotation: npt.ArrayLike = (0.0, 0.0, 0.0),
    release: bool = False,
) -> Action:
    """A giver's action from its parts; see `handover_marl.episode.spaces.giver_action_space`.

    Args:
        rate: Playback rate less the recorded one, -1 to 1.
        displacement: (3,) set-point of the wrist's displacement (m).
        rotation: (3,) set-point of its rotation vector (rad).
        release: Whether to let go now.
    """
    parts = [rate, *np.asarray(displacement), *np.asarray(rotation), float(release)]
    return np.array(parts, dtype=np.float32)


class Giver(Policy):
    """A policy for the human side.

    Pass the class wherever a giver is wanted, or register it for others through the entry-point group
    `handover_marl.givers`.
    """

    agent: ClassVar[str | None] = "giver"

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Decide on the deviation from the replay, (8,) float32 as `deviation` makes it.

        Args:
            observation: As described in `handover_marl.episode.observations.giver_observation_space`.
        """
