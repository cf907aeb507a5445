"""Givers that withdraw the hand: from a robot that approaches fast, or at random times."""

import math
from dataclasses import dataclass

import numpy as np

from handover_marl.config import CheckedConfig, bounded, check_order
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyArray, AnyIndices, ArrayFactory, to_numpy, widen
from handover_marl.geometry.poses import compute_lengths
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions

_MAX_WITHDRAWAL, _MAX_TIME = 0.3, 13.0  # m, s


@dataclass(frozen=True)
class WithdrawingConfig(CheckedConfig):
    """Configuration of `WithdrawingGiver`.

    Attributes:
        max_speed: Speed of the gripper towards the wrist above which the hand withdraws (m/s).
        max_distance: Distance from gripper to wrist beyond which the hand does not withdraw (m).
        withdrawal: Distance by which the hand withdraws (m).
        return_after: Time after which the hand returns, unless the gripper approaches fast (s).
    """

    max_speed: float = bounded(0.25, 0.0, 2.0)
    max_distance: float = bounded(0.45, 0.0, 1.5)
    withdrawal: float = bounded(0.15, 0.0, _MAX_WITHDRAWAL)
    return_after: float = bounded(0.8, 0.0, _MAX_TIME)


class WithdrawingGiver(ArrayGiver):
    """Giver that withdraws the hand while the gripper approaches fast, as a stress test."""

    name = "withdrawing"
    default_config = WithdrawingConfig()
    config: WithdrawingConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._last_distance, self._until = arrays.full(count, math.nan), arrays.full(count, -1.0)
        self._displacement = arrays.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation from the recording."""
        self._last_distance[row], self._until[row], self._displacement[row] = math.nan, -1.0, 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that withdraw the hands, or follow the recordings."""
        xp, config, now = self._arrays.xp, self.config, widen(observation["time"][:, 0])
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        distance = widen(compute_lengths(away))
        speed = (self._last_distance[rows] - distance) / self.control_period
        self._last_distance[rows] = distance
        # Before the second decision the speed is nan, which is not above the limit.
        is_present = observation["hand_present"][:, 0] != 0.0
        withdraws = is_present & (distance < config.max_distance) & (speed > config.max_speed)
        until = xp.where(withdraws, now + config.return_after, self._until[rows])
        withdrawal = config.withdrawal * away / compute_lengths(away).clip(1e-6)[:, None]
        displacement = xp.where(withdraws[:, None], withdrawal, self._displacement[rows])
        self._until[rows], self._displacement[rows] = until, displacement
        return self.make_actions(rows, displacement=xp.where((now < until)[:, None], displacement, 0.0))


@dataclass(frozen=True)
class InterruptingConfig(CheckedConfig):
    """Configuration of `InterruptingGiver`.

    Attributes:
        interruptions_per_second: Mean number of interruptions that start in a second without one.
        withdrawal: Distance by which the hand withdraws (m).
        shortest: Smallest duration of an interruption (s).
        longest: Largest duration of an interruption (s).
    """

    interruptions_per_second: float = bounded(0.6, 0.0, 5.0)
    withdrawal: float = bounded(0.15, 0.0, _MAX_WITHDRAWAL)
    shortest: float = bounded(0.5, 0.0, _MAX_TIME)
    longest: float = bounded(1.5, 0.0, _MAX_TIME)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "shortest", "longest")


class InterruptingGiver(ArrayGiver):
    """Giver that withdraws the hand from the gripper at random times, and offers the object again.

    Interruptions start after the object has been picked up and before it is released; their times do not depend
    on the robot. The limits of the giver's motion apply: with the default limits, the hand moves at up to 0.8 m/s
    and 5 m/s^2 relative to the recording, within 0.3 m of it.
    """

    name = "interrupting"
    default_config = InterruptingConfig()
    config: InterruptingConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes; times are on the host like the random numbers."""
        self._until, self._rngs = np.full(count, -1.0), [np.random.default_rng(0)] * count
        self._displacement = arrays.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation; the seed determines the times of the interruptions."""
        self._rngs[row], self._until[row], self._displacement[row] = np.random.default_rng(seed), -1.0, 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that withdraw the hands, or follow the recordings."""
        config, numbers = self.config, to_numpy(rows)
        now, holding, released = (to_numpy(observation[key][:, 0]) for key in ("time", "holding", "released"))
        away = _find_directions_away(observation)
        for place, row in enumerate(numbers.tolist()):
            rng, time = self._rngs[row], float(now[place])
            may_start = time >= self._until[row] and holding[place] and not released[place]
            if may_start and rng.random() < config.interruptions_per_second * self.control_period:
                self._until[row] = time + rng.uniform(config.shortest, config.longest)
                self._displacement[row] = config.withdrawal * away[place]
        is_away = self._arrays.asarray(now < self._until[numbers])[:, None]
        return self.make_actions(rows, displacement=self._arrays.xp.where(is_away, self._displacement[rows], 0.0))


def _find_directions_away(observation: Observation) -> AnyArray:
    """Return the unit vectors (r, 3) from the grippers to the objects."""
    away = widen(observation["object_poses"][:, 0, :3] - observation["gripper_pose"][:, :3])
    return away / compute_lengths(away).clip(1e-6)[:, None]
