"""Giver whose arm trembles and sinks."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from handover_marl.config import CheckedConfig, Limits
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action


@dataclass(frozen=True)
class TiredConfig(CheckedConfig):
    """Configuration of `TiredGiver`.

    Attributes:
        amplitude: Amplitude of the tremor along each axis (m).
        frequency: Frequency of the tremor (Hz).
        sinking: Speed at which the hand sinks (m/s).
        max_sinking: Largest distance by which the hand sinks (m).
    """

    limits: ClassVar[Limits] = {
        "amplitude": (0.0, 0.02),
        "frequency": (0.5, 8.0),
        "sinking": (0.0, 0.5),
        "max_sinking": (0.0, 0.3),
    }

    amplitude: float = 0.003
    frequency: float = 5.0
    sinking: float = 0.02
    max_sinking: float = 0.1


class TiredGiver(Giver):
    """Giver that replays the recording with a tremor, and whose hand sinks slowly while it holds the object.

    The tremor is a sine wave along each axis with a random phase. The limits of the giver's motion apply: with the
    default limits, the acceleration of the tremor is at most 5 m/s^2.

    Args:
        context: Robot and task, which this giver does not use.
        amplitude: Amplitude of the tremor along each axis, up to 0.02 m.
        frequency: Frequency of the tremor, 0.5 to 8 Hz.
        sinking: Speed at which the hand sinks, up to 0.5 m/s.
        max_sinking: Largest distance by which the hand sinks, up to 0.3 m.
    """

    name = "tired"
    # Samples of a period of the fastest tremor: six.
    control_period = 0.02

    def __init__(
        self,
        context: PolicyContext | None = None,
        amplitude: float = TiredConfig.amplitude,
        frequency: float = TiredConfig.frequency,
        sinking: float = TiredConfig.sinking,
        max_sinking: float = TiredConfig.max_sinking,
    ) -> None:
        super().__init__(context)
        self.config = TiredConfig(amplitude, frequency, sinking, max_sinking)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with random phases of the tremor."""
        self._phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
        self._holding_since: float | None = None

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) with the present displacement of the hand."""
        now, config = float(observation["time"][0]), self.config
        if self._holding_since is None and observation["holding"][0]:
            self._holding_since = now
        held = 0.0 if self._holding_since is None else now - self._holding_since
        displacement = config.amplitude * np.sin(2.0 * np.pi * config.frequency * now + self._phases)
        displacement[2] -= min(config.sinking * held, config.max_sinking)
        return make_giver_action(displacement=displacement)
