"""Giver that displaces and rotates the recorded motion at random."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, Limits
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action


@dataclass(frozen=True)
class DisplacedConfig(CheckedConfig):
    """Configuration of `DisplacedGiver`.

    Attributes:
        distance: Largest distance of the wrist from its recorded position (m).
        angle: Largest rotation of hand and object from their recorded orientation (rad).
    """

    limits: ClassVar[Limits] = {"distance": (0.0, 0.3), "angle": (0.0, 1.0)}

    distance: float = 0.15
    angle: float = 0.5


class DisplacedGiver(Giver):
    """Giver that displaces and rotates the recorded motion, by a random deviation that is drawn for each episode.

    Displacements are uniformly distributed in a ball, rotations have a random axis and a uniform angle. The hand
    moves to the displaced motion once it has picked up the object.

    Args:
        context: Robot and task, which this giver does not use.
        distance: Largest distance of the wrist from its recorded position, up to 0.3 m.
        angle: Largest rotation of hand and object, up to 1 rad.
    """

    name = "displaced"

    def __init__(
        self,
        context: PolicyContext | None = None,
        distance: float = DisplacedConfig.distance,
        angle: float = DisplacedConfig.angle,
    ) -> None:
        super().__init__(context)
        self.config = DisplacedConfig(distance, angle)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with a random deviation."""
        rng = np.random.default_rng(seed)
        radius = self.config.distance * rng.random() ** (1.0 / 3.0)
        self._displacement = radius * _draw_direction(rng)
        self._rotation = self.config.angle * rng.random() * _draw_direction(rng)

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) with the deviation of this episode."""
        return make_giver_action(displacement=self._displacement, rotation=self._rotation)


def _draw_direction(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return a random unit vector (3,)."""
    direction: npt.NDArray[np.float64] = Rotation.random(random_state=rng).as_matrix()[:, 0]
    return direction
