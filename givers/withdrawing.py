"""Givers that withdraw the hand: from a robot that approaches fast, or at random times."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import CheckedConfig, Limits, check_order
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action

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

    limits: ClassVar[Limits] = {
        "max_speed": (0.0, 2.0),
        "max_distance": (0.0, 1.5),
        "withdrawal": (0.0, _MAX_WITHDRAWAL),
        "return_after": (0.0, _MAX_TIME),
    }

    max_speed: float = 0.25
    max_distance: float = 0.45
    withdrawal: float = 0.15
    return_after: float = 0.8


class WithdrawingGiver(Giver):
    """Giver that withdraws the hand while the gripper approaches fast, as a stress test.

    Args:
        context: Robot and task, which this giver does not use.
        max_speed: Speed of the gripper towards the wrist above which the hand withdraws, up to 2 m/s.
        max_distance: Distance from gripper to wrist beyond which the hand does not withdraw, up to 1.5 m.
        withdrawal: Distance by which the hand withdraws, up to 0.3 m.
        return_after: Time after which the hand returns, unless the gripper approaches fast, up to 13 s.
    """

    name = "withdrawing"

    def __init__(
        self,
        context: PolicyContext | None = None,
        max_speed: float = WithdrawingConfig.max_speed,
        max_distance: float = WithdrawingConfig.max_distance,
        withdrawal: float = WithdrawingConfig.withdrawal,
        return_after: float = WithdrawingConfig.return_after,
    ) -> None:
        super().__init__(context)
        self.config = WithdrawingConfig(max_speed, max_distance, withdrawal, return_after)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without deviation from the recording."""
        self._last_distance: float | None = None
        self._until = -1.0
        self._displacement = np.zeros(3)

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that withdraws the hand, or the one that follows the recording."""
        now, config = float(observation["time"][0]), self.config
        away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
        distance = float(np.linalg.norm(away))
        last = self._last_distance
        speed = 0.0 if last is None else (last - distance) / self.control_period
        self._last_distance = distance
        present = bool(observation["hand_present"][0])
        if present and distance < config.max_distance and speed > config.max_speed:
            self._until = now + config.return_after
            self._displacement = config.withdrawal * away / max(distance, 1e-6)
        return make_giver_action(displacement=self._displacement if now < self._until else np.zeros(3))


@dataclass(frozen=True)
class InterruptingConfig(CheckedConfig):
    """Configuration of `InterruptingGiver`.

    Attributes:
        interruptions_per_second: Mean number of interruptions that start in a second without one.
        withdrawal: Distance by which the hand withdraws (m).
        shortest: Smallest duration of an interruption (s).
        longest: Largest duration of an interruption (s).
    """

    limits: ClassVar[Limits] = {
        "interruptions_per_second": (0.0, 5.0),
        "withdrawal": (0.0, _MAX_WITHDRAWAL),
        "shortest": (0.0, _MAX_TIME),
        "longest": (0.0, _MAX_TIME),
    }

    interruptions_per_second: float = 0.6
    withdrawal: float = 0.15
    shortest: float = 0.5
    longest: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "shortest", "longest")


class InterruptingGiver(Giver):
    """Giver that withdraws the hand from the gripper at random times, and offers the object again.

    Interruptions start after the object has been picked up and before it is released; their times do not depend
    on the robot. The limits of the giver's motion apply: with the default limits, the hand moves at up to 0.8 m/s
    and 5 m/s^2 relative to the recording, within 0.3 m of it.

    Args:
        context: Robot and task, which this giver does not use.
        interruptions_per_second: Mean number of interruptions that start in a second without one, up to 5.
        withdrawal: Distance by which the hand withdraws, up to 0.3 m.
        shortest: Smallest duration of an interruption, up to 13 s.
        longest: Largest duration of an interruption, up to 13 s.
    """

    name = "interrupting"

    def __init__(
        self,
        context: PolicyContext | None = None,
        interruptions_per_second: float = InterruptingConfig.interruptions_per_second,
        withdrawal: float = InterruptingConfig.withdrawal,
        shortest: float = InterruptingConfig.shortest,
        longest: float = InterruptingConfig.longest,
    ) -> None:
        super().__init__(context)
        self.config = InterruptingConfig(interruptions_per_second, withdrawal, shortest, longest)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without deviation; the seed determines the times of the interruptions."""
        self._rng = np.random.default_rng(seed)
        self._until = -1.0
        self._displacement = np.zeros(3)

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that withdraws the hand, or the one that follows the recording."""
        now, config = float(observation["time"][0]), self.config
        may_start = now >= self._until and bool(observation["holding"][0]) and not observation["released"][0]
        if may_start and self._rng.random() < config.interruptions_per_second * self.control_period:
            self._until = now + self._rng.uniform(config.shortest, config.longest)
            self._displacement = config.withdrawal * _find_direction_away(observation)
        return make_giver_action(displacement=self._displacement if now < self._until else np.zeros(3))


def _find_direction_away(observation: Observation) -> npt.NDArray[np.float64]:
    """Return the unit vector (3,) from the gripper to the object; upwards if they coincide."""
    away = (observation["object_poses"][0, :3] - observation["gripper_pose"][:3]).astype(np.float64)
    length = float(np.linalg.norm(away))
    return away / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
