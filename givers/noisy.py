"""Giver with random deviations from the recording."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from handover_marl.config import CheckedConfig, Limits
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action


@dataclass(frozen=True)
class NoisyConfig(CheckedConfig):
    """Configuration of `NoisyGiver`.

    Attributes:
        displacement: Standard deviation of each component of the wrist's displacement (m).
        rotation: Standard deviation of each component of the wrist's rotation vector (rad).
        rate: Standard deviation of the playback rate.
        time_constant: Correlation time of the noise (s).
    """

    limits: ClassVar[Limits] = {
        "displacement": (0.0, 0.1),
        "rotation": (0.0, 0.5),
        "rate": (0.0, 0.5),
        "time_constant": (0.05, 13.0),
    }

    displacement: float = 0.02
    rotation: float = 0.1
    rate: float = 0.15
    time_constant: float = 0.5


class NoisyGiver(Giver):
    """Giver with Ornstein-Uhlenbeck noise on playback rate, wrist position and wrist rotation.

    The limits of the giver's motion apply, so that fast noise is smoothed.

    Args:
        context: Robot and task, which this giver does not use.
        displacement: Standard deviation of each component of the wrist's displacement, up to 0.1 m.
        rotation: Standard deviation of each component of the wrist's rotation vector, up to 0.5 rad.
        rate: Standard deviation of the playback rate, up to 0.5.
        time_constant: Correlation time of the noise, 0.05 to 13 s.
    """

    name = "noisy"

    def __init__(
        self,
        context: PolicyContext | None = None,
        displacement: float = NoisyConfig.displacement,
        rotation: float = NoisyConfig.rotation,
        rate: float = NoisyConfig.rate,
        time_constant: float = NoisyConfig.time_constant,
    ) -> None:
        super().__init__(context)
        self.config = NoisyConfig(displacement, rotation, rate, time_constant)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without deviation."""
        self._rng = np.random.default_rng(seed)
        self._deviation = np.zeros(7)

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) with the next random deviation from the recording."""
        config = self.config
        deviations = np.array([config.rate, *[config.displacement] * 3, *[config.rotation] * 3])
        decay = np.exp(-self.control_period / config.time_constant)
        noise = self._rng.standard_normal(7)
        self._deviation = decay * self._deviation + np.sqrt(1.0 - decay**2) * deviations * noise
        return make_giver_action(self._deviation[0], self._deviation[1:4], self._deviation[4:])
