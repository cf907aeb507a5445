"""Givers that replay the recorded motion at another speed, or with pauses."""

from dataclasses import dataclass

import numpy as np

from handover_marl.config import CheckedConfig, bounded, check_order
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory, to_numpy
from handover_marl.givers.array_giver import ArrayGiver, compute_gripper_object_distances
from handover_marl.policies.batch import Actions

_MAX_PAUSE = 13.0  # s


@dataclass(frozen=True)
class HesitantConfig(CheckedConfig):
    """Configuration of `HesitantGiver`.

    Attributes:
        pauses_per_second: Mean number of pauses that start in a second without a pause.
        shortest_pause: Smallest duration of a pause (s).
        longest_pause: Largest duration of a pause (s).
    """

    pauses_per_second: float = bounded(0.6, 0.0, 5.0)
    shortest_pause: float = bounded(0.3, 0.0, _MAX_PAUSE)
    longest_pause: float = bounded(1.0, 0.0, _MAX_PAUSE)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "shortest_pause", "longest_pause")


class HesitantGiver(ArrayGiver):
    """Giver that pauses the recorded motion at random times."""

    name = "hesitant"
    default_config = HesitantConfig()
    config: HesitantConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes, on the host like the random numbers."""
        self._until, self._rngs = np.zeros(count), [np.random.default_rng(0)] * count

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without a pause; the seed determines the times of later pauses."""
        self._rngs[row], self._until[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause, or replay at the recorded speed."""
        config, numbers = self.config, to_numpy(rows)
        now = to_numpy(observation["time"][:, 0]).astype(np.float64)
        for row, time in zip(numbers.tolist(), now.tolist(), strict=True):
            rng = self._rngs[row]
            if time >= self._until[row] and rng.random() < config.pauses_per_second * self.control_period:
                self._until[row] = time + rng.uniform(config.shortest_pause, config.longest_pause)
        return self.make_pauses(rows, self._arrays.asarray(now < self._until[numbers]))


@dataclass(frozen=True)
class HurriedConfig(CheckedConfig):
    """Configuration of `HurriedGiver`.

    Attributes:
        min_rate: Smallest playback rate minus 1; negative values are slower than recorded.
        max_rate: Largest playback rate minus 1.
    """

    min_rate: float = bounded(0.4, -0.8, 1.0)
    max_rate: float = bounded(1.0, -0.8, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "min_rate", "max_rate")


class HurriedGiver(ArrayGiver):
    """Giver that replays the recorded motion faster, or slower, at a random speed per episode."""

    name = "hurried"
    default_config = HurriedConfig()
    config: HurriedConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._rate = arrays.zeros(count)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with a random playback speed."""
        self._rate[row] = np.random.default_rng(seed).uniform(self.config.min_rate, self.config.max_rate)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that replay at the speeds drawn for these episodes."""
        return self.make_actions(rows, rate=self._rate[rows])


@dataclass(frozen=True)
class StopWhenNearConfig(CheckedConfig):
    """Configuration of `StopWhenNearGiver`.

    Attributes:
        distance: Distance from the Panda's hand link to the object's origin below which the recording pauses (m).
    """

    distance: float = bounded(0.35, 0.0, 1.5)


class StopWhenNearGiver(ArrayGiver):
    """Giver that pauses the recording while the gripper is near the object.

    GenH2R has such a giver (Wang et al., CVPR 2024).
    """

    name = "stop_when_near"
    default_config = StopWhenNearConfig()
    config: StopWhenNearConfig

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode; this giver keeps no state."""

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause, or replay at the recorded speed."""
        return self.make_pauses(rows, compute_gripper_object_distances(observation) < self.config.distance)
