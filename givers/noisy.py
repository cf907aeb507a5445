"""Giver with random deviations from the recording."""

from dataclasses import dataclass

import numpy as np

from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions


@dataclass(frozen=True)
class NoisyConfig(CheckedConfig):
    """Configuration of `NoisyGiver`.

    Attributes:
        displacement: Standard deviation of each component of the wrist's displacement (m).
        rotation: Standard deviation of each component of the wrist's rotation vector (rad).
        rate: Standard deviation of the playback rate.
        time_constant: Correlation time of the noise (s).
    """

    displacement: float = bounded(0.02, 0.0, 0.1)
    rotation: float = bounded(0.1, 0.0, 0.5)
    rate: float = bounded(0.15, 0.0, 0.5)
    time_constant: float = bounded(0.5, 0.05, 13.0)


class NoisyGiver(ArrayGiver):
    """Giver with Ornstein-Uhlenbeck noise on playback rate, wrist position and wrist rotation.

    The limits of the giver's motion apply, so that fast noise is smoothed.
    """

    name = "noisy"
    default_config = NoisyConfig()
    config: NoisyConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._rngs, self._deviation = [np.random.default_rng(0)] * count, arrays.zeros((count, 7))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation."""
        self._rngs[row], self._deviation[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the next random deviations from the recordings."""
        config = self.config
        scale = np.array([config.rate, *[config.displacement] * 3, *[config.rotation] * 3])
        decay = float(np.exp(-self.control_period / config.time_constant))
        noise = np.array([self._rngs[row].standard_normal(7) for row in rows.tolist()])
        steps = self._arrays.asarray(np.sqrt(1.0 - decay**2) * scale * noise)
        deviation = self._deviation[rows] = decay * self._deviation[rows] + steps
        return self.make_actions(rows, deviation[:, 0], deviation[:, 1:4], deviation[:, 4:])
