"""Where an object will be held out, as far as its motion so far tells."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

_SAME_TIME = 1e-6  # s


@dataclass(frozen=True)
class OfferConfig:
    """How an object with velocity v at p goes on.

    The remaining way is

        ahead * v + pull * tanh(|v| / brisk) * (place - p).

    A moving object is drawn to where people hold things out, one at rest stays. `experiments/offer_error.py` fits and
    measures this. An object that moves but gets nowhere hovers: it goes on for a shorter time and is drawn nowhere.

    Attributes:
        ahead: Time for which the velocity goes on (s).
        pull: Share of the way to `place` that a brisk object still goes.
        brisk: Speed scale of that (m/s).
        place: Where objects are held out in the middle, world frame (m).
        turn_ahead: Time for which the turning goes on (s).
        smoothing: Time constant of the velocities (s).
        slow: An object slower than this rests (m/s).
        hover: One that is no farther than this (m) from where it was
        hover_time: this long ago (s) hovers, if it had been lifted by then, by
        hover_lifted: at least this (m), and
        hover_ahead: goes on with its velocity for this time (s).
    """

    ahead: float = 0.21
    pull: float = 0.61
    brisk: float = 0.3
    place: tuple[float, float, float] = (0.577, 0.139, 1.239)
    turn_ahead: float = 0.1
    smoothing: float = 0.05
    slow: float = 0.05
    hover: float = 0.08
    hover_time: float = 0.6
    hover_lifted: float = 0.1
    hover_ahead: float = 0.05


class OfferPrediction:
    """Follows one object through an episode.

    Attributes:
        velocity: (3,) of the object (m/s).
        turning: (3,) its angular velocity as a rotation vector in the world (rad/s).
        latest: (3,) velocity between the last two sights (m/s), and
        latest_turning: (3,) angular velocity between them (rad/s); not smoothed.
        acceleration: (3,) how the former changes (m/s^2).
        rest: How long the object has been slow (s).
    """

    def __init__(self, config: OfferConfig) -> None:
        self.config = config
        self.velocity, self.turning, self.rest = np.zeros(3), np.zeros(3), 0.0
        self.latest, self.latest_turning, self.acceleration = np.zeros(3), np.zeros(3), np.zeros(3)
        self._step = np.inf
        self.start: Array | None = None
        self._time, self._pose = 0.0, np.zeros(7)
        self._track: deque[tuple[float, Array]] = deque()

    def see(self, time: float, pose: Array) -> None:
        """Take note of the object's pose (7,) in the world at a time (s)."""
        if self.start is None:
            self.start = pose[:3].copy()
        elif time > self._time:
            step = time - self._time
            kept = float(np.exp(-step / self.config.smoothing))
            turn = (Rotation.from_quat(pose[3:]) * Rotation.from_quat(self._pose[3:]).inv()).as_rotvec()
            before = self.latest
            self.latest, self.latest_turning = (pose[:3] - self._pose[:3]) / step, turn / step
            self.acceleration = (self.latest - before) / (0.5 * (step + self._step))
            self._step = step
            self.velocity = kept * self.velocity + (1.0 - kept) * self.latest
            self.turning = kept * self.turning + (1.0 - kept) * self.latest_turning
            self.rest = self.rest + step if self.speed < self.config.slow else 0.0
        self._time, self._pose = time, pose.copy()
        self._track.append((time, self._pose[:3]))
        while len(self._track) > 1 and self._track[1][0] < time - self.config.hover_time + _SAME_TIME:
            self._track.popleft()

    @property
    def hovers(self) -> bool:
        """Whether the object, at rest or not, is held up and gets nowhere."""
        if self.start is None:
            return False
        config, (since, place) = self.config, self._track[0]
        lifted, gone = (float(np.linalg.norm(place - other)) for other in (self.start, self._pose[:3]))
        long = self._time - since > config.hover_time - _SAME_TIME
        return long and lifted > config.hover_lifted and gone < config.hover

    @property
    def speed(self) -> float:
        """Of the object (m/s)."""
        return float(np.linalg.norm(self.velocity))

    @property
    def lifted(self) -> float:
        """How far the object is from where it was first seen (m)."""
        return 0.0 if self.start is None else float(np.linalg.norm(self._pose[:3] - self.start))

    def offered(self) -> Array:
        """The pose (7,) at which the object will be held out."""
        config = self.config
        if self.hovers:
            return self.soon(config.hover_ahead)
        drawn = config.pull * np.tanh(self.speed / config.brisk)
        place = self._pose[:3] + config.ahead * self.velocity + drawn * (np.array(config.place) - self._pose[:3])
        return np.concatenate([place, self._turned(config.turn_ahead * self.turning)])

    def soon(self, ahead: float) -> Array:
        """The pose (7,) a short time (s) from now, at the present velocity."""
        return np.concatenate([self._pose[:3] + ahead * self.latest, self._turned(ahead * self.latest_turning)])

    def twist(self, point: Array, ahead: float) -> tuple[Array, Array]:
        """Velocity (m/s) of a point (3,) that is fixed to the object, and angular velocity (rad/s), (3,) each.

        Args:
            point: In the world (m).
            ahead: For so long from now (s); in the middle of that time.
        """
        since = 0.5 * (self._step + ahead) if np.isfinite(self._step) else 0.0
        velocity = self.latest + since * self.acceleration
        return velocity + np.cross(self.latest_turning, point - self._pose[:3]), self.latest_turning

    def _turned(self, turn: Array) -> Array:
        turned: Array = (Rotation.from_rotvec(turn) * Rotation.from_quat(self._pose[3:])).as_quat()
        return turned
