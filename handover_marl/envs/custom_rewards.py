"""User-defined rewards: functions of a transition, combinations of rewards, and the check of their terms."""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.reward_terms import TermRewardSource, TermWeights
from handover_marl.envs.rewards import (
    REWARDS,
    PresetRewards,
    RewardConfig,
    Terms,
    make_reward_config,
)
from handover_marl.envs.transition import Transition
from handover_marl.episode.observations import add_episode_axis
from handover_marl.errors import HandoverError, OptionError, ResetNeededError, RewardError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ONLY_ROW
from handover_marl.policies.registry import import_reference

_Function = TypeVar("_Function", bound=Callable[..., Any])
Position: TypeAlias = tuple[float, ...]
#: Function from a transition to the reward terms by agent and name.
CustomReward: TypeAlias = Callable[[Transition], Mapping[str, Mapping[str, float]]]


def declare_terms(giver: tuple[str, ...] = (), receiver: tuple[str, ...] = ()) -> Callable[[_Function], _Function]:
    """Return a decorator that declares the names of the terms that a user-defined reward returns.

    Without it, the names are those of a first call with a transition in which nothing moves. Declared
    terms that a call does not return are 0.

    Args:
        giver: Names of the giver's terms.
        receiver: Names of the receiver's terms.
    """

    def decorate(function: _Function) -> _Function:
        function.terms = {"giver": giver, "receiver": receiver}  # type: ignore[attr-defined]
        return function

    return decorate


@dataclass(frozen=True)
class CombinedRewards:
    """Weighted sum of rewards, made by `combine_rewards`.

    Attributes:
        parts: Pairs of weight and reward.
    """

    parts: tuple[tuple[float, Any], ...]


#: Value of `rewards`: name, weights, function, combination, or text `module:name`.
RewardLike: TypeAlias = str | RewardConfig | TermWeights | CombinedRewards | CustomReward


def combine_rewards(*parts: RewardLike | tuple[float, RewardLike]) -> CombinedRewards:
    """Combine rewards to their weighted sum; infos contain the weighted terms of all parts.

    Args:
        parts: Rewards, each a value that `rewards` accepts, or a pair of weight and reward.

    Raises:
        OptionError: There is no part, a weight is not a finite number, or a part is not a reward.
        UnknownNameError: There is no reward of a name.
    """
    if not parts:
        raise OptionError("combine_rewards() must have at least one reward, got none")
    pairs = []
    for part in parts:
        weight, reward = part if isinstance(part, tuple) and len(part) == 2 else (1.0, part)
        if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not math.isfinite(weight):
            raise OptionError(f"weight of a reward must be a finite number, got {weight!r}")
        resolve_rewards(reward)
        pairs.append((float(weight), reward))
    return CombinedRewards(tuple(pairs))


def resolve_rewards(rewards: Any) -> Any:
    """Return the `RewardConfig`, weights, combination or function that a value of `rewards` refers to.

    Raises:
        UnknownNameError: There is no reward of that name, or `module:name` cannot be imported.
        OptionError: The value is neither a name nor weights nor callable.
    """
    if isinstance(rewards, str) and ":" in rewards:
        rewards = import_reference("rewards", rewards, (*REWARDS, "module:name"))
    if isinstance(rewards, (str, RewardConfig)):
        return make_reward_config(rewards)
    if not isinstance(rewards, (TermWeights, CombinedRewards)) and not callable(rewards):
        raise OptionError(
            f"rewards must be one of {', '.join(REWARDS)}, a RewardConfig, TermWeights, a function of a transition or "
            f"module:name, got {rewards!r}"
        )
    return rewards


def set_discount(rewards: RewardLike, discount: float) -> Any:
    """Return the rewards with a learner's discount factor in all shaping terms; functions stay unchanged."""
    found = resolve_rewards(rewards)
    if isinstance(found, RewardConfig):
        return replace(found, gamma=discount)
    if isinstance(found, CombinedRewards):
        return CombinedRewards(tuple((weight, set_discount(part, discount)) for weight, part in found.parts))
    return rewards


class RewardSource(Protocol):
    """Reward terms of both agents, computed from transitions."""

    def start(self, transition: Transition) -> dict[str, Terms]:
        """Start an episode; return the terms, all 0, by agent."""

    def compute(self, transition: Transition) -> dict[str, Terms]:
        """Return the reward terms of a control step, by agent."""


def make_reward_source(rewards: RewardLike, goal: Position) -> RewardSource:
    """Make the source of reward terms for one environment.

    Each environment gets a deep copy of a reward object, so that environments do not share its attributes.

    Args:
        rewards: Any value that `rewards` accepts.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
    """
    found = resolve_rewards(rewards)
    if isinstance(found, RewardConfig):
        return PresetRewardSource(found, goal)
    if isinstance(found, CombinedRewards):
        return SummedRewardSource([(weight, make_reward_source(part, goal)) for weight, part in found.parts])
    if isinstance(found, TermWeights):
        return TermRewardSource(found)
    return CustomRewardSource(found() if isinstance(found, type) else copy.deepcopy(found))


class PresetRewardSource:
    """Source of the terms of preset rewards: "sparse", "shaped" or a `RewardConfig`.

    Args:
        config: Weights of the terms.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
    """

    def __init__(self, config: RewardConfig, goal: Position) -> None:
        self._rewards = PresetRewards(config, goal, 1, NUMPY_ARRAYS)

    def start(self, transition: Transition) -> dict[str, Terms]:
        """Start an episode; return the terms, all 0, by agent."""
        self._rewards.start(ONLY_ROW, self._read_state(transition))
        return {agent: dict.fromkeys(names, 0.0) for agent, names in self._rewards.names.items()}

    def compute(self, transition: Transition) -> dict[str, Terms]:
        """Return the reward terms of a control step, by agent."""
        status = np.array([int(transition.status)])
        terms = self._rewards.compute_terms(ONLY_ROW, status, self._read_state(transition))
        return {agent: {name: float(value[0]) for name, value in own.items()} for agent, own in terms.items()}

    def _read_state(self, transition: Transition) -> dict[str, Any]:
        if not self._rewards.needs_state:
            return {}
        state = add_episode_axis(transition.next_state)
        return {**state, "grasped": np.array([transition.contacts.both_fingers_touch])}


class SummedRewardSource:
    """Source of the weighted terms of several rewards; terms of one agent must have different names.

    Args:
        parts: Pairs of weight and source of terms.
    """

    def __init__(self, parts: list[tuple[float, RewardSource]]) -> None:
        self._parts = parts

    def start(self, transition: Transition) -> dict[str, Terms]:
        """Start an episode; return the terms, all 0, by agent.

        Raises:
            RewardError: Two parts have a term of the same name.
        """
        terms: dict[str, Terms] = {agent: {} for agent in AGENTS}
        for _, part in self._parts:
            for agent, own in part.start(transition).items():
                repeated = sorted(terms[agent].keys() & own.keys())
                if repeated:
                    raise RewardError(
                        f"reward terms must have different names, got {repeated[0]!r} of the {agent} twice; rename one"
                    )
                terms[agent] |= own
        return terms

    def compute(self, transition: Transition) -> dict[str, Terms]:
        """Return the weighted terms of a control step by agent."""
        terms: dict[str, Terms] = {agent: {} for agent in AGENTS}
        for weight, part in self._parts:
            for agent, own in part.compute(transition).items():
                terms[agent].update({name: weight * value for name, value in own.items()})
        return terms


class CustomRewardSource:
    """Source of the terms of a user-defined reward function; checks the names and values of the terms.

    Args:
        function: Function of a transition; its method `reset(transition)`, if it has one, is called at
            the start of an episode.
    """

    def __init__(self, function: CustomReward) -> None:
        self.function = function
        self.name = str(getattr(function, "__qualname__", None) or type(function).__qualname__)
        declared = getattr(function, "terms", None)
        self._names = None if declared is None else self._check_declared(declared)

    def start(self, transition: Transition) -> dict[str, Terms]:
        """Start an episode; return the terms, all 0, by agent.

        Args:
            transition: Transition in which nothing moves.

        Raises:
            RewardError: The function fails or returns something else than terms by agent.
        """
        reset = getattr(self.function, "reset", None)
        if callable(reset):
            self._run(reset, transition)
        if self._names is None:
            # A copy, so that this call leaves nothing in the function's memory.
            first = self._run(copy.deepcopy(self.function), transition)
            self._names = self._check_declared(first)
        return {agent: dict.fromkeys(names, 0.0) for agent, names in self._names.items()}

    def compute(self, transition: Transition) -> dict[str, Terms]:
        """Return the checked terms of a control step by agent; terms that are not returned are 0.

        Raises:
            ResetNeededError: No episode is running.
            RewardError: The function fails, or a term is of an unknown agent, has an unknown name, or is
                no finite number.
        """
        if self._names is None:
            raise ResetNeededError("no episode is running; call start() before compute()")
        found = self._run(self.function, transition)
        if type(found) is not dict:
            self._check_mapping("terms", found)
        terms = {agent: dict.fromkeys(names, 0.0) for agent, names in self._names.items()}
        for agent, own in found.items():
            checked = terms.get(agent)
            if checked is None:
                raise self._make_unknown_agent_error(agent)
            if type(own) is not dict:
                self._check_mapping(f"terms of the {agent}", own)
            for name, value in own.items():
                if name not in checked:
                    raise RewardError(
                        f"term {name!r} of the {agent} in reward {self.name!r} must be one of "
                        f"{', '.join(self._names[agent]) or 'none'}, the terms of the first call; return it in every "
                        "step, or declare it with @declare_terms"
                    )
                # Fast for what is mostly returned.
                is_finite = type(value) is float and value - value == 0.0
                checked[name] = value if is_finite else self._check_value(agent, name, value)
        return terms

    def _run(self, function: Callable[[Transition], Any], transition: Transition) -> Any:
        try:
            return function(transition)
        except HandoverError:
            raise
        except Exception as error:  # code of the user
            raise RewardError(f"reward {self.name!r} failed ({type(error).__name__}: {error})") from error

    def _check_declared(self, declared: Any) -> dict[str, tuple[str, ...]]:
        """Return the names of the terms of both agents."""
        self._check_mapping("terms", declared)
        for agent, names in declared.items():
            if agent not in AGENTS:
                raise self._make_unknown_agent_error(agent)
            if isinstance(names, str) or not hasattr(names, "__iter__"):
                self._check_mapping(f"terms of the {agent}", names)
            for name in names:
                if not isinstance(name, str) or not name.isprintable() or not name:
                    raise RewardError(
                        f"names of the terms of the {agent} in reward {self.name!r} must be printable text, got "
                        f"{name!r}"
                    )
        return {agent: tuple(declared.get(agent, ())) for agent in AGENTS}

    def _check_mapping(self, what: str, value: object) -> None:
        if not isinstance(value, Mapping):
            raise RewardError(
                f"{what} of reward {self.name!r} must be a dict, got {value!r}; return "
                '{"receiver": {"name": value}, "giver": {}}'
            )

    def _make_unknown_agent_error(self, agent: object) -> RewardError:
        return RewardError(
            f"terms of reward {self.name!r} must be for {' and '.join(AGENTS)}, got some for {agent!r}; correct the "
            "name of the agent"
        )

    def _check_value(self, agent: str, name: str, value: object) -> float:
        where = f"term {name!r} of the {agent} in reward {self.name!r}"
        try:
            number = np.asarray(value)
        except Exception:  # tensors with a gradient, ragged lists
            number = np.array(None)
        if number.dtype.kind not in "biuf":
            raise RewardError(f"{where} must be a number, got {type(value).__name__}; convert it with float()")
        if number.shape != ():
            raise RewardError(f"{where} must be a single number, got an array of shape {number.shape}; sum it")
        if not np.isfinite(number):
            raise RewardError(f"{where} must be finite, got {value!r}; check divisions and empty hands")
        return float(number)
