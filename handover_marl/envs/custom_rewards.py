"""User-defined rewards: functions of a transition, combinations of rewards, and the check of their terms."""

import copy
import functools
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from handover_marl.config import check_number
from handover_marl.envs.agents import AGENTS
from handover_marl.envs.rewards import (
    REWARDS,
    ArrayTerms,
    RewardWeights,
    StepData,
    TermNames,
    WeightedRewardSource,
)
from handover_marl.envs.transition import Transition
from handover_marl.errors import OptionError, RewardError, check_name, report_failure
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyIndices, ArrayFactory
from handover_marl.policies.registry import import_reference

#: Function that returns the reward terms of a `Transition`, by agent and name.
CustomReward: TypeAlias = Callable[[Transition], Mapping[str, Mapping[str, float]]]


@dataclass(frozen=True)
class CombinedRewards:
    """Weighted sum of rewards, made by `combine_rewards`.

    Attributes:
        parts: Pairs of weight and reward.
    """

    parts: tuple[tuple[float, Any], ...]


#: Value of `rewards`: name of a preset, weights, function, combination, or text `module:name`.
RewardLike: TypeAlias = str | RewardWeights | CombinedRewards | CustomReward


def combine_rewards(*parts: RewardLike | tuple[float, RewardLike]) -> CombinedRewards:
    """Combine rewards into a weighted sum; infos contain the weighted terms of all parts.

    Args:
        parts: Rewards, each a value that `rewards` accepts, or a pair of weight and reward.

    Raises:
        OptionError: There is no part, a weight is not a finite number, or a part is not a reward.
        UnknownNameError: A name is not the name of a reward.
    """
    if not parts:
        raise OptionError("combine_rewards() must have at least one reward, got none")
    pairs = []
    for part in parts:
        weight, reward = part if isinstance(part, tuple) and len(part) == 2 else (1.0, part)
        check_number("weight of a reward", weight)
        resolve_rewards(reward)
        pairs.append((float(weight), reward))
    return CombinedRewards(tuple(pairs))


def resolve_rewards(rewards: Any) -> Any:
    """Return the weights of a preset's name or the value that text `module:name` imports; return others unchanged."""
    if isinstance(rewards, str) and ":" in rewards:
        rewards = import_reference("rewards", rewards, (*REWARDS, "module:name"))
    if isinstance(rewards, str):
        check_name("rewards", rewards, REWARDS)
        return REWARDS[rewards]
    if not isinstance(rewards, (RewardWeights, CombinedRewards)) and not callable(rewards):
        raise OptionError(
            f"rewards must be one of {', '.join(REWARDS)}, RewardWeights, a function of a transition or module:name, "
            f"got {rewards!r}"
        )
    if inspect.isfunction(rewards) and hasattr(rewards, "reset"):
        name = rewards.__qualname__
        raise OptionError(f"rewards with a reset must be of a class, got the function {name!r}; write a class")
    return rewards


def set_discount(rewards: RewardLike, discount: float) -> Any:
    """Return rewards whose shaping terms have the discount factor `discount`; user-defined functions stay unchanged."""
    found = resolve_rewards(rewards)
    if isinstance(found, RewardWeights):
        return replace(found, gamma=discount)
    if isinstance(found, CombinedRewards):
        return CombinedRewards(tuple((weight, set_discount(part, discount)) for weight, part in found.parts))
    return rewards


class RewardSource:
    """Reward terms of both agents in n episodes; the terms of an agent must have different names.

    The argument `rows` (r,) of methods has the indices of r episodes. If a user-defined reward is a class, each episode
    has its own instance; if it is an instance, its own deep copy. Plain functions are shared by all episodes.

    Args:
        rewards: Any value that `rewards` accepts.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
        count: Number n of episodes.
        arrays: Creator of the arrays that `compute` returns.
    """

    def __init__(
        self, rewards: RewardLike, goal: tuple[float, ...], count: int = 1, arrays: ArrayFactory = NUMPY_ARRAYS
    ) -> None:
        self._parts: list[tuple[float, WeightedRewardSource | CustomRewardSource]] = []
        for weight, part in _list_parts(rewards):
            if isinstance(part, RewardWeights):
                self._parts.append((weight, WeightedRewardSource(part, goal, count, arrays)))
            else:
                self._parts.append((weight, CustomRewardSource(part, count, arrays)))

    def start(self, rows: AnyIndices, step: StepData) -> TermNames:
        """Start the episodes `rows` with their first states in `step`; return the names of the terms by agent."""
        names: dict[str, list[str]] = {agent: [] for agent in AGENTS}
        for _, part in self._parts:
            for agent, own in part.start(rows, step).items():
                for name in own:
                    if name in names[agent]:
                        raise RewardError(
                            f"reward terms must have different names, got {name!r} of the {agent} twice; rename one"
                        )
                    names[agent].append(name)
        return names

    def compute(self, rows: AnyIndices, step: StepData) -> dict[str, ArrayTerms]:
        """Return the weighted terms (r,) of the last control step of the episodes `rows`, by agent and name."""
        terms: dict[str, ArrayTerms] = {agent: {} for agent in AGENTS}
        for weight, part in self._parts:
            for agent, own in part.compute(rows, step).items():
                terms[agent] |= {name: weight * value for name, value in own.items()}
        return terms


def _list_parts(rewards: RewardLike, weight: float = 1.0) -> list[tuple[float, Any]]:
    """Return pairs (weight, reward) whose weighted sum is `rewards`; combinations are resolved into their parts."""
    reward = resolve_rewards(rewards)
    if not isinstance(reward, CombinedRewards):
        return [(weight, reward)]
    return [pair for own, part in reward.parts for pair in _list_parts(part, weight * own)]


class CustomRewardSource:
    """Terms of a user-defined reward in n episodes; wrong names or values of terms raise `RewardError`.

    `reward` is a function of a transition, an object that can be called like one, or a class of such objects. The
    method `reset(transition)` of an object, if there is one, is called at the start of the episode.
    """

    def __init__(self, reward: Any, count: int, arrays: ArrayFactory) -> None:
        self._arrays, self._name = arrays, str(getattr(reward, "__qualname__", None) or type(reward).__qualname__)
        make = reward if isinstance(reward, type) else functools.partial(copy.deepcopy, reward)
        self._functions: list[CustomReward] = [self._run(make) for _ in range(count)]
        self._names: dict[str, list[str]] = {}

    def start(self, rows: AnyIndices, step: StepData) -> TermNames:
        """Start the episodes `rows`; return the names of the terms by agent, see `RewardSource.start`."""
        for row, transition in zip(rows.tolist(), step.read_transitions(), strict=True):
            function = self._functions[row]
            reset = getattr(function, "reset", None)
            if callable(reset):
                self._run(reset, transition)
            if not self._names:
                # A copy, so that this call leaves nothing in the function's memory.
                terms = self._run(self._run(copy.deepcopy, function), transition)
                self._check_agents(terms)
                self._names = {agent: list(terms.get(agent, ())) for agent in AGENTS}
        return self._names

    def compute(self, rows: AnyIndices, step: StepData) -> dict[str, ArrayTerms]:
        """Return the values (r,) of the terms by agent and name; 0 for a term that is missing in this step."""
        values = {agent: {name: np.zeros(len(rows)) for name in names} for agent, names in self._names.items()}
        for number, (row, transition) in enumerate(zip(rows.tolist(), step.read_transitions(), strict=True)):
            terms = self._run(self._functions[row], transition)
            self._check_agents(terms)
            for agent, own in terms.items():
                for name, value in own.items():
                    label = f"term {name!r} of the {agent} in reward {self._name!r}"
                    if name not in values[agent]:
                        raise RewardError(
                            f"{label} must be one of {', '.join(values[agent]) or 'none'}, the terms of the first "
                            "call; return it in every step"
                        )
                    if np.ndim(value) or not isinstance(value, (int, float, np.number, np.bool_, np.ndarray)):
                        raise RewardError(f"{label} must be a single number, got {value!r}; convert it with float()")
                    if not math.isfinite(value):
                        raise RewardError(f"{label} must be finite, got {value!r}; check divisions and empty hands")
                    values[agent][name][number] = value
        return {
            agent: {name: self._arrays.asarray(value) for name, value in own.items()} for agent, own in values.items()
        }

    def _run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        with report_failure(RewardError, f"reward {self._name!r}"):
            return function(*arguments)

    def _check_agents(self, terms: Any) -> None:
        """Check that a user-defined reward returned terms by agent and name."""
        is_by_agent = isinstance(terms, Mapping) and not terms.keys() - set(AGENTS)
        by_agent = list(terms.values()) if is_by_agent else [None]
        if not all(isinstance(own, Mapping) and all(isinstance(name, str) for name in own) for own in by_agent):
            raise RewardError(
                f"terms of reward {self._name!r} must be a dict for {' and '.join(AGENTS)}, got {terms!r}; return "
                '{"receiver": {"name": value}, "giver": {}}'
            )
