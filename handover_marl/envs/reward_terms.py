"""Reward terms, each with formula and unit, and their weighted sum.

| term | value in a control step of duration T | unit |
|---|---|---|
| success | 1 in the step that completes the handover, else 0 | 1 |
| gripper_path | distance of the hand link's positions before and after the step | m |
| hand_path | distance of the person's wrist positions before and after the step; 0 without a hand | m |
| gripper_jerk | norm of the third difference of the last four positions of the hand link, divided by T^2 | m/s^2 |
| hand_jerk | the same for the person's wrist; 0 without a hand | m/s^2 |
| object_force | sum of the normal forces between robot and object at the end of the step, times T | N s |
| hand_force | sum of the normal forces between robot and human hand at the end of the step, times T | N s |
| time | T | s |
| clearance | min(d, 0.1 m) - 0.1 m, times T, at most 0; 0 without a hand | m s |

The hand link is the Panda's `panda_hand`. d is the distance between the four boxes that bound the open
gripper and the nearest of the 16 joint origins of the person's hand. All values but `success` are sums
or integrals over time: their sum over an episode hardly depends on the control period. The jerk terms
are the norm of the jerk integrated over the step; they are 0 in the first two steps of an episode and
in a last step that is shorter than the others.
"""

import functools
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.rewards import Terms
from handover_marl.envs.transition import Transition
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError, check_name
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.planning.clearance import GRIPPER_BOX_CENTERS, GRIPPER_BOX_HALF_SIZES

Array = npt.NDArray[np.float64]

#: Distance beyond which the term `clearance` is 0 (m).
CLEARANCE_MARGIN = 0.1


@dataclass(frozen=True)
class RewardTerm:
    """Reward term: one number for each control step.

    Attributes:
        unit: Unit of the value.
        compute: Function that returns the value from the last control steps of the episode, up to three, in order.
    """

    unit: str
    compute: Callable[[Sequence[Transition]], float]


def compute_path(body: str, steps: Sequence[Transition]) -> float:
    """Return the distance (m) of a body's positions before and after the last step; 0 without a hand."""
    before, after = (read_position(body, state) for state in (steps[-1].state, steps[-1].next_state))
    return 0.0 if before is None or after is None else math.dist(before, after)


def compute_jerk(body: str, steps: Sequence[Transition]) -> float:
    """Return the norm of the third difference of a body's last four positions, divided by T^2 (m/s^2).

    0 in the first two steps of an episode, in a step that is shorter than the one before it, and without a hand.
    """
    durations = [step.duration for step in steps]
    positions = [read_position(body, state) for state in (*(step.state for step in steps), steps[-1].next_state)]
    present = [position for position in positions if position is not None]
    if len(present) < 4 or max(durations) - min(durations) > 1e-6:
        return 0.0
    jerk = (d - 3.0 * c + 3.0 * b - a for a, b, c, d in zip(*present, strict=True))
    return math.hypot(*jerk) / durations[-1] ** 2


def compute_clearance(steps: Sequence[Transition]) -> float:
    """Return min(d, 0.1) - 0.1 after the last step, times its duration (m s), at most 0."""
    distance = compute_hand_distance(steps[-1].next_state)
    return 0.0 if distance is None else (min(distance, CLEARANCE_MARGIN) - CLEARANCE_MARGIN) * steps[-1].duration


#: Reward terms by name.
TERMS = {
    "success": RewardTerm("1", lambda steps: float(steps[-1].is_success)),
    "gripper_path": RewardTerm("m", functools.partial(compute_path, "gripper")),
    "hand_path": RewardTerm("m", functools.partial(compute_path, "hand")),
    "gripper_jerk": RewardTerm("m/s^2", functools.partial(compute_jerk, "gripper")),
    "hand_jerk": RewardTerm("m/s^2", functools.partial(compute_jerk, "hand")),
    "object_force": RewardTerm("N s", lambda steps: steps[-1].contacts.robot_object_force * steps[-1].duration),
    "hand_force": RewardTerm("N s", lambda steps: steps[-1].contacts.robot_hand_force * steps[-1].duration),
    "time": RewardTerm("s", lambda steps: steps[-1].duration),
    "clearance": RewardTerm("m s", compute_clearance),
}


@dataclass(frozen=True)
class TermWeights:
    """Weights of reward terms, a value that `rewards` and `combine_rewards` accept.

    Attributes:
        receiver: Weights of the receiver's terms by name, see `TERMS`.
        giver: Weights of the giver's terms by name.

    Raises:
        UnknownNameError: There is no reward term of a name.
        OptionError: A weight is not a finite number.
    """

    receiver: Mapping[str, float] = field(default_factory=dict)
    giver: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for agent in AGENTS:
            weights = getattr(self, agent)
            if not isinstance(weights, Mapping):
                raise OptionError(f"{agent} of TermWeights must be a dict of weights by term, got {weights!r}")
            for name, weight in weights.items():
                check_name("reward term", name, TERMS)
                is_number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
                if not is_number or not math.isfinite(weight):
                    raise OptionError(f"weight of term {name!r} of the {agent} must be a finite number, got {weight!r}")


class TermRewardSource:
    """Source of the weighted reward terms of both agents.

    Args:
        weights: Weights by agent and term.
    """

    def __init__(self, weights: TermWeights) -> None:
        self._weights = {agent: dict(getattr(weights, agent)) for agent in AGENTS}
        self._names = {name for own in self._weights.values() for name in own}
        self._steps: deque[Transition] = deque(maxlen=3)

    def start(self, transition: Transition) -> dict[str, Terms]:
        """Start an episode; return the terms, all 0, by agent."""
        self._steps.clear()
        return {agent: dict.fromkeys(weights, 0.0) for agent, weights in self._weights.items()}

    def compute(self, transition: Transition) -> dict[str, Terms]:
        """Return the weighted terms of a control step by agent."""
        self._steps.append(transition)
        values = {name: float(TERMS[name].compute(self._steps)) for name in self._names}
        return {
            agent: {name: weight * values[name] for name, weight in weights.items()}
            for agent, weights in self._weights.items()
        }


def read_position(body: str, state: Observation) -> list[float] | None:
    """Return the position (3,) of the hand link or of the wrist, world frame (m); None without a hand.

    Args:
        body: "gripper" or "hand".
        state: Full state, as `Transition.state`.
    """
    if body == "gripper":
        position: Any = state["gripper_pose"][:3]
    elif state["hand_present"][0]:
        position = state["hand_keypoints"][0]
    else:
        return None
    numbers: list[float] = position.tolist()
    return numbers


def compute_hand_distance(state: Observation) -> float | None:
    """Return the distance (m) of the gripper from the person's hand, None without a hand.

    Args:
        state: Full state, as `Transition.state`.
    """
    if not state["hand_present"][0]:
        return None
    pose = state["gripper_pose"].astype(np.float64)
    points: Array = inverse_transform_points(pose, state["hand_keypoints"].astype(np.float64))
    outside = np.maximum(np.abs(points[:, None] - GRIPPER_BOX_CENTERS) - GRIPPER_BOX_HALF_SIZES, 0.0)
    return float(np.sqrt((outside**2).sum(-1)).min())
