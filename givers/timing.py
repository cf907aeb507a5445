"""Givers that replay the recorded motion at another speed, or with pauses."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from handover_marl.config import CheckedConfig, Limits, check_order
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action

# Playback rate minus 1 of a paused recording, and of one at the recorded speed.
_PAUSE, _NORMAL = -1.0, 0.0
_MAX_PAUSE = 13.0  # s


@dataclass(frozen=True)
class HesitantConfig(CheckedConfig):
    """Configuration of `HesitantGiver`.

    Attributes:
        pauses_per_second: Mean number of pauses that start in a second without a pause.
        shortest_pause: Smallest duration of a pause (s).
        longest_pause: Largest duration of a pause (s).
    """

    limits: ClassVar[Limits] = {
        "pauses_per_second": (0.0, 5.0),
        "shortest_pause": (0.0, _MAX_PAUSE),
        "longest_pause": (0.0, _MAX_PAUSE),
    }

    pauses_per_second: float = 0.6
    shortest_pause: float = 0.3
    longest_pause: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "shortest_pause", "longest_pause")


class HesitantGiver(Giver):
    """Giver that pauses the recorded motion at random times.

    Args:
        context: Robot and task, which this giver does not use.
        pauses_per_second: Mean number of pauses that start in a second without a pause, up to 5.
        shortest_pause: Smallest duration of a pause, up to 13 s.
        longest_pause: Largest duration of a pause, up to 13 s.
    """

    name = "hesitant"

    def __init__(
        self,
        context: PolicyContext | None = None,
        pauses_per_second: float = HesitantConfig.pauses_per_second,
        shortest_pause: float = HesitantConfig.shortest_pause,
        longest_pause: float = HesitantConfig.longest_pause,
    ) -> None:
        super().__init__(context)
        self.config = HesitantConfig(pauses_per_second, shortest_pause, longest_pause)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without a pause; the seed determines the times of later pauses."""
        self._rng = np.random.default_rng(seed)
        self._until = 0.0

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that pauses, or the one that replays at the recorded speed."""
        now, config = float(observation["time"][0]), self.config
        if now >= self._until and self._rng.random() < config.pauses_per_second * self.control_period:
            self._until = now + self._rng.uniform(config.shortest_pause, config.longest_pause)
        return make_giver_action(rate=_PAUSE if now < self._until else _NORMAL)


@dataclass(frozen=True)
class HurriedConfig(CheckedConfig):
    """Configuration of `HurriedGiver`.

    Attributes:
        min_rate: Smallest playback rate minus 1; negative values are slower than recorded.
        max_rate: Largest playback rate minus 1.
    """

    limits: ClassVar[Limits] = {"min_rate": (-0.8, 1.0), "max_rate": (-0.8, 1.0)}

    min_rate: float = 0.4
    max_rate: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "min_rate", "max_rate")


class HurriedGiver(Giver):
    """Giver that replays the recorded motion faster, or slower, at a random speed per episode.

    Args:
        context: Robot and task, which this giver does not use.
        min_rate: Smallest playback rate minus 1, from -0.8 (a fifth of the recorded speed) to 1 (twice).
        max_rate: Largest playback rate minus 1, from -0.8 to 1.
    """

    name = "hurried"

    def __init__(
        self,
        context: PolicyContext | None = None,
        min_rate: float = HurriedConfig.min_rate,
        max_rate: float = HurriedConfig.max_rate,
    ) -> None:
        super().__init__(context)
        self.config = HurriedConfig(min_rate, max_rate)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with a random playback speed."""
        self._rate = float(np.random.default_rng(seed).uniform(self.config.min_rate, self.config.max_rate))

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that replays the recording at the speed drawn for this episode."""
        return make_giver_action(rate=self._rate)


@dataclass(frozen=True)
class StopWhenNearConfig(CheckedConfig):
    """Configuration of `StopWhenNearGiver`.

    Attributes:
        distance: Distance from the Panda's hand link to the object's origin below which the recording pauses (m).
    """

    limits: ClassVar[Limits] = {"distance": (0.0, 1.5)}

    distance: float = 0.35


class StopWhenNearGiver(Giver):
    """Giver that pauses the recording while the gripper is near the object.

    GenH2R has such a giver (Wang et al., CVPR 2024).

    Args:
        context: Robot and task, which this giver does not use.
        distance: Distance from the Panda's hand link to the object's origin below which the recording
            pauses, up to 1.5 m.
    """

    name = "stop_when_near"

    def __init__(self, context: PolicyContext | None = None, distance: float = StopWhenNearConfig.distance) -> None:
        super().__init__(context)
        self.config = StopWhenNearConfig(distance)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; this giver keeps no state."""

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that pauses, or the one that replays at the recorded speed."""
        distance = np.linalg.norm(observation["gripper_pose"][:3] - observation["object_poses"][0, :3])
        return make_giver_action(rate=_PAUSE if distance < self.config.distance else _NORMAL)
