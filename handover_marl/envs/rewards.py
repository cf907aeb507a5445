"""What the agents are rewarded for: named terms, weighted by a frozen configuration and summed.

The default is the task alone: 1 to both in the step that completes the handover. `SHAPED` adds guidance for the
receiver and costs for the giver. Guidance is potential-based (Ng et al., ICML 1999): gamma times the potential
after a step less that before, and no potential once the episode has ended. Over an episode it adds up to the same
whatever was done, so that it cannot change which policy is best.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.protocol.status import EpisodeStatus

# Terms that are known from how an episode ended.
_OUTCOMES = ("task", "contact", "drop")


@dataclass(frozen=True)
class ReceiverWeights:
    """Weights of the receiver's terms.

    Attributes:
        task: 1 in the step that completes the handover.
        distance: Guidance; the potential is 1 less the distance (m) of the middle between the fingertips and the
            object's origin, and 1 while it is grasped.
        grasp: Guidance; the potential is 1 while both fingers are on the object.
        goal: Guidance; the potential is 1 less the distance of hand link and goal (m) while grasped, else 0.
        contact: 1 in the step in which the robot touches the person.
        drop: 1 in the step in which the object is dropped.
    """

    task: float = 1.0
    distance: float = 0.0
    grasp: float = 0.0
    goal: float = 0.0
    contact: float = 0.0
    drop: float = 0.0


@dataclass(frozen=True)
class GiverWeights:
    """Weights of the giver's terms.

    Attributes:
        task: 1 in the step that completes the handover.
        effort: The wrist's squared speed of deviation, added up over time (m^2/s).
        discomfort: How far the wrist is from where the person had it (m, and rad / 3), added up over time (s).
        waiting: Time (s) during which the object is held out and not yet taken.
        contact: 1 in the step in which the robot touches the person.
        drop: 1 in the step in which the object is dropped.
    """

    task: float = 1.0
    effort: float = 0.0
    discomfort: float = 0.0
    waiting: float = 0.0
    contact: float = 0.0
    drop: float = 0.0


@dataclass(frozen=True)
class RewardConfig:
    """Both agents' weights.

    Attributes:
        receiver: The receiver's.
        giver: The giver's.
        gamma: Discount that guidance is made for; the learner's own.
    """

    receiver: ReceiverWeights = field(default_factory=ReceiverWeights)
    giver: GiverWeights = field(default_factory=GiverWeights)
    gamma: float = 0.99


SPARSE = RewardConfig()
SHAPED = RewardConfig(
    # The task outweighs what ends with the guidance.
    receiver=ReceiverWeights(task=3.0, distance=0.5, grasp=0.5, goal=0.5, contact=-0.5, drop=-0.5),
    giver=GiverWeights(effort=-0.05, discomfort=-0.02, waiting=-0.02, contact=-0.5, drop=-0.5),
)
REWARDS = {"sparse": SPARSE, "shaped": SHAPED}


def reward_config(chosen: str | RewardConfig) -> RewardConfig:
    """A configuration by name, or as given.

    Raises:
        UnknownNameError: There is none of that name.
        OptionError: It is neither a name nor a configuration.
    """
    if isinstance(chosen, RewardConfig):
        return chosen
    if not isinstance(chosen, str):
        raise OptionError(f"rewards={chosen!r} must be one of {', '.join(REWARDS)} or a RewardConfig")
    if chosen not in REWARDS:
        raise UnknownNameError("rewards", chosen, REWARDS)
    return REWARDS[chosen]


@dataclass(frozen=True)
class Situation:
    """What rewards depend on, after a control step or at the start.

    Attributes:
        time: Since the start (s).
        gripper: (3,) position of the Panda's hand link (m).
        fingertips: (3,) the middle between its fingertips (m).
        item: (3,) position of the object (m).
        grasped: Whether both fingers are on it.
        deviation: (6,) the giver's wrist displacement (m) and rotation vector (rad).
        held_out: Whether the person holds the object, picked up and not let go.
    """

    time: float
    gripper: tuple[float, ...]
    fingertips: tuple[float, ...]
    item: tuple[float, ...]
    grasped: bool
    deviation: tuple[float, ...]
    held_out: bool


class Rewards:
    """Terms from one situation to the next.

    Args:
        config: Weights.
        goal: (3,) where the gripper must bring the object (m).
        start: The first situation.

    Attributes:
        only_outcomes: Whether nothing but how an episode ends has a weight, so that `outcome` says it all.
    """

    def __init__(self, config: RewardConfig, goal: tuple[float, ...], start: Situation) -> None:
        self._config, self._goal = config, goal
        self._last = start
        weights = [*vars(config.receiver).items(), *vars(config.giver).items()]
        self.only_outcomes = not any(weight for name, weight in weights if name not in _OUTCOMES)

    def outcome(self, status: EpisodeStatus) -> tuple[dict[str, float], dict[str, float]]:
        """The receiver's and the giver's terms where `only_outcomes` have weights."""
        receiver, giver = (
            _weighted(weights, {**dict.fromkeys(vars(weights), 0.0), **_outcome(status)})
            for weights in (self._config.receiver, self._config.giver)
        )
        return receiver, giver

    def receiver(self, now: Situation, status: EpisodeStatus) -> dict[str, float]:
        """The receiver's weighted terms for a step that ended in `now`."""
        before, after = potentials(self._last, self._goal), potentials(now, self._goal)
        # An episode that only ran out of time is cut off, not over: what comes next still counts.
        if status & ~EpisodeStatus.TIMEOUT:
            after = dict.fromkeys(after, 0.0)
        guidance = {name: self._config.gamma * after[name] - before[name] for name in before}
        return _weighted(self._config.receiver, {**guidance, **_outcome(status)})

    def giver(self, now: Situation, status: EpisodeStatus) -> dict[str, float]:
        """The giver's weighted terms for a step that ended in `now`."""
        period = now.time - self._last.time
        way = math.dist(now.deviation[:3], self._last.deviation[:3])
        away = math.hypot(*now.deviation[:3]) + math.hypot(*now.deviation[3:]) / 3.0
        costs = {
            "effort": way**2 / period if period > 0.0 else 0.0,
            "discomfort": away * period,
            "waiting": period if self._last.held_out else 0.0,
        }
        return _weighted(self._config.giver, {**costs, **_outcome(status)})

    def go_on(self, now: Situation) -> None:
        """The next step starts from here."""
        self._last = now


def potentials(situation: Situation, goal: tuple[float, ...]) -> dict[str, float]:
    """The potentials of guidance."""
    return {
        "distance": 1.0 if situation.grasped else 1.0 - math.dist(situation.fingertips, situation.item),
        "grasp": float(situation.grasped),
        "goal": 1.0 - math.dist(situation.gripper, goal) if situation.grasped else 0.0,
    }


@functools.cache
def _outcome(status: EpisodeStatus) -> Mapping[str, float]:
    return {
        "task": float(bool(status & EpisodeStatus.SUCCESS)),
        "contact": float(bool(status & EpisodeStatus.HUMAN_CONTACT)),
        "drop": float(bool(status & EpisodeStatus.OBJECT_DROP)),
    }


def _weighted(weights: ReceiverWeights | GiverWeights, values: Mapping[str, float]) -> dict[str, float]:
    return {name: weight * values[name] for name, weight in vars(weights).items()}
