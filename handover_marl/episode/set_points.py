"""Going to set-points the way people do: with limited speed and acceleration."""

import math

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP

_ARRIVED = 1e-6


class SetPoint:
    """A vector on its way to where it is wanted. Its lists are replaced, never changed, so that copies may be shallow.

    Args:
        size: Number of components.
        speed: Largest speed (units/s).
        acceleration: Largest acceleration (units/s^2).

    Attributes:
        value: (size,) where it is.
    """

    def __init__(self, size: int, speed: float, acceleration: float) -> None:
        self.value = [0.0] * size
        self._velocity = [0.0] * size
        self._speed, self._acceleration = speed, acceleration

    def approach(self, goal: npt.ArrayLike, steps: int) -> npt.NDArray[np.float64]:
        """Go towards a goal for some steps and return the (steps, size) way."""
        wanted = [float(component) for component in np.asarray(goal)]
        way = np.empty((steps, len(wanted)))
        for row in range(steps):
            if self.value == wanted and not any(self._velocity):
                # There, it stays.
                way[row:] = wanted
                break
            self._step(wanted)
            way[row] = self.value
        return way

    def _step(self, goal: list[float]) -> None:
        period = TIME_STEP
        left = [wanted - present for wanted, present in zip(goal, self.value, strict=True)]
        distance = math.hypot(*left)
        change = self._acceleration * period
        if distance < _ARRIVED and math.hypot(*self._velocity) <= change:
            self.value, self._velocity = list(goal), [0.0] * len(goal)
            return
        # As fast as still allows stopping in time, in steps of finite length.
        braking = math.sqrt(2.0 * self._acceleration * distance + change**2 / 4.0) - change / 2.0
        speed = min(self._speed, braking, distance / period)
        wanted = [speed * part / distance if distance > 0.0 else 0.0 for part in left]
        needed = [new - old for new, old in zip(wanted, self._velocity, strict=True)]
        size = math.hypot(*needed)
        share = 1.0 if size <= change else change / size
        self._velocity = [old + share * part for old, part in zip(self._velocity, needed, strict=True)]
        self.value = [present + velocity * period for present, velocity in zip(self.value, self._velocity, strict=True)]
