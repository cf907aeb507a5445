"""What every giver is: a policy that deviates from the replayed human motion."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.observations import Observation

Action = npt.NDArray[np.float32]


def deviation(
    rate: float = 0.0,
    displacement: npt.ArrayLike = (0.0, 0.0, 0.0),
    rotation: npt.ArrayLike = (0.0, 0.0, 0.0),
    release: bool = False,
) -> Action:
    """A giver's action from its parts; see `handover_marl.spaces.giver_action_space`.

    Args:
        rate: Playback rate less the recorded one, -1 to 1.
        displacement: (3,) set-point of the wrist's displacement (m).
        rotation: (3,) set-point of its rotation vector (rad).
        release: Whether to let go now.
    """
    parts = [rate, *np.asarray(displacement), *np.asarray(rotation), float(release)]
    return np.array(parts, dtype=np.float32)


class Giver(ABC):
    """A policy for the human side.

    A giver sees observations only and never holds an environment. Register one for others through the
    entry-point group `handover_marl.givers`.

    Attributes:
        name: What it is registered under.
        control_period: How often it decides (s); a whole number of milliseconds.
    """

    name: ClassVar[str]
    control_period: ClassVar[float] = 0.1

    @abstractmethod
    def reset(self, seed: int | None = None) -> None:
        """Forget the last episode."""

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Decide on the deviation from the replay, an element of `handover_marl.spaces.giver_action_space`."""

    @property
    def label(self) -> str:
        """What results are filed under: the name, and what else tells two apart."""
        return self.name

    @property
    def hold_time(self) -> float:
        """How long (s) the last action stands before the giver wants to be asked again."""
        return self.control_period
