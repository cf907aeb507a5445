"""How motors follow their targets while nothing pushes back."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import MotorConfig


class Follower:
    """Joints that make up a fixed share of their position error in every step, as Bullet's position motors do.

    Beside the simulated motors of hand and objects this is right to 1e-4 (m, rad).

    Args:
        motors: One entry per joint.
        start: (d,) where the joints are (m, rad).

    Attributes:
        position: (d,) where the joints are at the end of the last path, float64.
        path: (n, d) where they are after each step of the present motion.
    """

    def __init__(self, motors: Sequence[MotorConfig], start: npt.ArrayLike) -> None:
        self._gains = np.array([motor.position_gain for motor in motors])
        self.position = np.array(start, dtype=np.float64)
        self.path = self.position[None]

    def follow(self, targets: npt.NDArray[np.float32]) -> None:
        """Work out the path for (n, d) targets; step by step, so that it does not depend on how they are cut."""
        position, wanted = self.position, targets.astype(np.float64)
        if (wanted == position).all():
            # What lies still takes no work; the recurrence would say the same.
            self.path = wanted
            return
        path = np.empty(wanted.shape)
        for row, target in enumerate(wanted):
            position = position + self._gains * (target - position)
            path[row] = position
        self.position, self.path = position, path
