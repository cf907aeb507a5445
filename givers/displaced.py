"""Giver that displaces and rotates the recorded motion at random."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions


@dataclass(frozen=True)
class DisplacedConfig(CheckedConfig):
    """Configuration of `DisplacedGiver`.

    Attributes:
        distance: Largest distance of the wrist from its recorded position (m).
        angle: Largest rotation of hand and object from their recorded orientation (rad).
    """

    distance: float = bounded(0.15, 0.0, 0.3)
    angle: float = bounded(0.5, 0.0, 1.0)


class DisplacedGiver(ArrayGiver):
    """Giver that displaces and rotates the recorded motion, by a random deviation that is drawn for each episode.

    Displacements are uniformly distributed in a ball, rotations have a random axis and a uniform angle. The hand
    moves to the displaced motion once it has picked up the object.
    """

    name = "displaced"
    default_config = DisplacedConfig()
    config: DisplacedConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._displacement, self._rotation = arrays.zeros((count, 3)), arrays.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with a random deviation."""
        rng = np.random.default_rng(seed)
        radius = self.config.distance * rng.random() ** (1.0 / 3.0)
        self._displacement[row] = self._arrays.asarray(radius * _draw_direction(rng))
        self._rotation[row] = self._arrays.asarray(self.config.angle * rng.random() * _draw_direction(rng))

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the deviations of these episodes."""
        return self.make_actions(rows, displacement=self._displacement[rows], rotation=self._rotation[rows])


def _draw_direction(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return a random unit vector (3,)."""
    return np.asarray(Rotation.random(random_state=rng).as_matrix()[:, 0])
