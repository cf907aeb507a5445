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

import math
from collections.abc import Mapping
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


class RewardTerm:
    """Base class of reward terms: one number for each control step.

    Attributes:
        unit: Unit of the value.
    """

    unit = "1"

    def reset(self, transition: Transition) -> None:
        """Start an episode.

        Args:
            transition: Transition in which nothing moves, with the first observations.
        """

    def compute(self, transition: Transition) -> float:
        """Return the value of the term in a control step."""
        raise NotImplementedError


class SuccessTerm(RewardTerm):
    """Term that is 1 in the step that completes the handover, else 0."""

    def compute(self, transition: Transition) -> float:
        """Return 1 in the step that completes the handover, else 0."""
        return float(transition.is_success)


class BodyTerm(RewardTerm):
    """Base class of the terms of one body.

    Args:
        body: "gripper", "hand" or "object", one that the term is defined for.
    """

    def __init__(self, body: str) -> None:
        self._body = body


class PathTerm(BodyTerm):
    """Length of the way in a step (m), of the Panda's hand link or of the person's wrist."""

    unit = "m"

    def compute(self, transition: Transition) -> float:
        """Return the distance (m) of the positions before and after the step; 0 without a hand."""
        before, after = (read_position(self._body, state) for state in (transition.state, transition.next_state))
        return 0.0 if before is None or after is None else math.dist(before, after)


class JerkTerm(BodyTerm):
    """Jerk of the Panda's hand link or of the person's wrist, integrated over the step (m/s^2)."""

    unit = "m/s^2"

    def __init__(self, body: str) -> None:
        super().__init__(body)
        self._positions: list[list[float]] = []
        self._period = 0.0

    def reset(self, transition: Transition) -> None:
        """Discard the positions of the last episode; store the first position of the new one."""
        first = read_position(self._body, transition.next_state)
        self._positions, self._period = ([] if first is None else [first]), transition.duration

    def compute(self, transition: Transition) -> float:
        """Return the norm of the third difference of the last four positions, divided by T^2 (m/s^2)."""
        position = read_position(self._body, transition.next_state)
        if position is None or abs(transition.duration - self._period) > 1e-6:
            self._positions = []
            return 0.0
        self._positions = [*self._positions[-3:], position]
        if len(self._positions) < 4:
            return 0.0
        jerk = (d - 3.0 * c + 3.0 * b - a for a, b, c, d in zip(*self._positions, strict=True))
        return math.hypot(*jerk) / transition.duration**2


class ForceTerm(BodyTerm):
    """Normal force between robot and object or hand at the end of the step, times its duration (N s)."""

    unit = "N s"

    def compute(self, transition: Transition) -> float:
        """Return the sum of the normal forces (N) in the last physics step, times the duration (s)."""
        contacts = transition.contacts
        force = contacts.robot_object_force if self._body == "object" else contacts.robot_hand_force
        return float(force) * transition.duration


class TimeTerm(RewardTerm):
    """Duration of the step (s)."""

    unit = "s"

    def compute(self, transition: Transition) -> float:
        """Return the duration of the step (s)."""
        return transition.duration


class ClearanceTerm(RewardTerm):
    """Amount by which the gripper is nearer to the person's hand than 0.1 m, times the duration (m s)."""

    unit = "m s"

    def compute(self, transition: Transition) -> float:
        """Return min(d, 0.1) - 0.1 after the step, times its duration (m s), at most 0."""
        distance = compute_hand_distance(transition.next_state)
        return 0.0 if distance is None else (min(distance, CLEARANCE_MARGIN) - CLEARANCE_MARGIN) * transition.duration


#: Reward terms by name: class and its argument.
TERMS: dict[str, tuple[type[RewardTerm], tuple[str, ...]]] = {
    "success": (SuccessTerm, ()),
    "gripper_path": (PathTerm, ("gripper",)),
    "hand_path": (PathTerm, ("hand",)),
    "gripper_jerk": (JerkTerm, ("gripper",)),
    "hand_jerk": (JerkTerm, ("hand",)),
    "object_force": (ForceTerm, ("object",)),
    "hand_force": (ForceTerm, ("hand",)),
    "time": (TimeTerm, ()),
    "clearance": (ClearanceTerm, ()),
}


def make_term(name: str) -> RewardTerm:
    """Make a reward term.

    Raises:
        UnknownNameError: There is no reward term of that name.
    """
    check_name("reward term", name, TERMS)
    term_class, arguments = TERMS[name]
    return term_class(*arguments)


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
        self._terms = {name: make_term(name) for own in self._weights.values() for name in own}

    def start(self, transition: Transition) -> dict[str, Terms]:
        """Start an episode; return the terms, all 0, by agent."""
        for term in self._terms.values():
            term.reset(transition)
        return {agent: dict.fromkeys(weights, 0.0) for agent, weights in self._weights.items()}

    def compute(self, transition: Transition) -> dict[str, Terms]:
        """Return the weighted terms of a control step by agent."""
        values = {name: term.compute(transition) for name, term in self._terms.items()}
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
