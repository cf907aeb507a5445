"""Giver whose arm trembles and sinks."""

import math
from dataclasses import dataclass

import numpy as np

from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory, widen
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions


@dataclass(frozen=True)
class TiredConfig(CheckedConfig):
    """Configuration of `TiredGiver`.

    Attributes:
        amplitude: Amplitude of the tremor along each axis (m).
        frequency: Frequency of the tremor (Hz).
        sinking: Speed at which the hand sinks (m/s).
        max_sinking: Largest distance by which the hand sinks (m).
    """

    amplitude: float = bounded(0.003, 0.0, 0.02)
    frequency: float = bounded(5.0, 0.5, 8.0)
    sinking: float = bounded(0.02, 0.0, 0.5)
    max_sinking: float = bounded(0.1, 0.0, 0.3)


class TiredGiver(ArrayGiver):
    """Giver that replays the recording with a tremor, and whose hand sinks slowly while it holds the object.

    The tremor is a sine wave along each axis with a random phase. The limits of the giver's motion apply: with the
    default limits, the acceleration of the tremor is at most 5 m/s^2.
    """

    name = "tired"
    # Samples of a period of the fastest tremor: six.
    control_period = 0.02
    default_config = TiredConfig()
    config: TiredConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._phases, self._holding_since = arrays.zeros((count, 3)), arrays.full(count, math.nan)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with random phases of the tremor."""
        phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
        self._phases[row], self._holding_since[row] = self._arrays.asarray(phases), math.nan

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the present displacements of the hands."""
        xp, config, now = self._arrays.xp, self.config, widen(observation["time"][:, 0])
        since, holds = self._holding_since[rows], observation["holding"][:, 0] != 0.0
        since = self._holding_since[rows] = xp.where(xp.isnan(since) & holds, now, since)
        held = xp.where(xp.isnan(since), 0.0, now - since)
        angles = 2.0 * math.pi * config.frequency * now[:, None] + self._phases[rows]
        displacement = config.amplitude * xp.sin(angles)
        displacement[:, 2] -= (config.sinking * held).clip(max=config.max_sinking)
        return self.make_actions(rows, displacement=displacement)
