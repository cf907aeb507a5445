"""Commands for an arm whose motors make up a fixed share of their error in every step."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ServoConfig:
    """How fast the arm may move.

    Attributes:
        speeds: Largest joint speeds, the Panda's (rad/s).
        share: Of these that is used.
        acceleration: Largest change of a joint's speed (rad/s^2).
        braking: Deceleration towards a goal that rests (rad/s^2).
    """

    speeds: tuple[float, ...] = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
    share: float = 1.0
    acceleration: float = 20.0
    braking: float = 12.0


class ArmServo:
    """Turns joint velocities into targets.

    Position motors lag behind their target by their time constant; a target that leads by as much makes the arm arrive
    when it should.

    Args:
        config: Speeds.
        gain: Share of the position error that a motor corrects in a step.
        time_step: Seconds in a step.

    Attributes:
        period: How long a command stands (s); may be set anew before each.
    """

    def __init__(self, config: ServoConfig, gain: float, period: float, time_step: float) -> None:
        self.config = config
        self.period = period
        self.limits = config.share * np.array(config.speeds)
        self._gain, self._time_step = gain, time_step
        self._velocity = np.zeros(len(config.speeds))

    def reset(self) -> None:
        """Stand still."""
        self._velocity = np.zeros(len(self.config.speeds))

    @property
    def velocity(self) -> Array:
        """(7,) joint velocities commanded last (rad/s)."""
        return self._velocity

    def towards(self, joints: Array, goal: Array) -> Array:
        """(7,) velocities (rad/s) along the straight joint line to a goal, braking before it.

        Args:
            joints: (7,) where the arm is (rad).
            goal: (7,) where it is to be.
        """
        way = goal - joints
        # Speeds change once in a period: what is too fast to stop in time is half a period's braking less.
        half = 0.5 * self.config.braking * self.period
        slow = float(np.sqrt(half**2 + 2.0 * self.config.braking * np.abs(way).max())) - half
        wanted = way / self.period
        most = float(np.abs(wanted).max())
        if most > slow:
            wanted = wanted * (slow / most)
        return wanted

    def limited(self, velocity: Array) -> Array:
        """(7,) the velocity in the same direction that keeps to the speed limits."""
        over = float((np.abs(velocity) / self.limits).max())
        return velocity / over if over > 1.0 else velocity

    def reached(self, velocity: Array, acceleration: float | None = None) -> Array:
        """(..., 7) velocities that the next command makes of wanted ones (rad/s), as far as acceleration allows."""
        # Each joint for itself: were all slowed down alike, one that turns round would make the others overshoot.
        most = (acceleration or self.config.acceleration) * self.period
        found: Array = self._velocity + np.clip(velocity - self._velocity, -most, most)
        return found

    def command(self, joints: Array, velocity: Array, acceleration: float | None = None) -> Array:
        """(7,) targets (rad) that make the arm move at a velocity, as far as its acceleration allows.

        Args:
            joints: (7,) where the arm is (rad).
            velocity: (7,) wanted (rad/s).
            acceleration: Largest change of a joint's speed (rad/s^2), if not the usual one.
        """
        self._velocity = self.reached(velocity, acceleration)
        lead = 1.0 / (1.0 - (1.0 - self._gain) ** (self.period / self._time_step))
        target: Array = joints + lead * self.period * self._velocity
        return target
