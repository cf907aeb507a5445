"""Going to set-points the way people do: with limited speed and acceleration."""

import math

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP

_ARRIVED = 1e-6


class SetPoint:
    """A vector of three on its way to where it is wanted; its lists are replaced, never changed: copies may be shallow.

    Args:
        speed: Largest speed (units/s).
        acceleration: Largest acceleration (units/s^2).

    Attributes:
        value: (3,) where it is.
    """

    def __init__(self, speed: float, acceleration: float) -> None:
        self.value = [0.0] * 3
        self._velocity = [0.0] * 3
        self._speed, self._acceleration = speed, acceleration

    def approach(self, goal: npt.ArrayLike, steps: int) -> npt.NDArray[np.float64]:
        """Go towards a goal for some steps and return the (steps, 3) way."""
        wanted = [float(component) for component in np.asarray(goal)]
        way = []
        for _ in range(steps):
            if self.value == wanted and not any(self._velocity):
                # There, it stays.
                break
            self._step(*wanted)
            way.append(self.value)
        way += [wanted] * (steps - len(way))
        return np.array(way).reshape(steps, 3)

    def _step(self, goal_x: float, goal_y: float, goal_z: float) -> None:
        # Component by component: these are single steps of physics, and there are many of them.
        x, y, z = self.value
        u, v, w = self._velocity
        left_x, left_y, left_z = goal_x - x, goal_y - y, goal_z - z
        distance = math.hypot(left_x, left_y, left_z)
        change = self._acceleration * TIME_STEP
        if distance < _ARRIVED and math.hypot(u, v, w) <= change:
            self.value, self._velocity = [goal_x, goal_y, goal_z], [0.0] * 3
            return
        # As fast as still allows stopping in time, in steps of finite length.
        braking = math.sqrt(2.0 * self._acceleration * distance + change**2 / 4.0) - change / 2.0
        speed = min(self._speed, braking, distance / TIME_STEP)
        if distance > 0.0:
            left_x, left_y, left_z = speed * left_x / distance, speed * left_y / distance, speed * left_z / distance
        needed_x, needed_y, needed_z = left_x - u, left_y - v, left_z - w
        size = math.hypot(needed_x, needed_y, needed_z)
        share = 1.0 if size <= change else change / size
        u, v, w = u + share * needed_x, v + share * needed_y, w + share * needed_z
        self.value, self._velocity = [x + u * TIME_STEP, y + v * TIME_STEP, z + w * TIME_STEP], [u, v, w]
