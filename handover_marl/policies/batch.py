"""Policies that act in many episodes at once, as one policy on arrays or as one policy per episode."""

import copy
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF, WorldConfig
from handover_marl.datasets.dataset import Dataset
from handover_marl.episode.loop import call_policy, start_policy, steps_from_hold_time
from handover_marl.episode.observations import Observation, add_episode_axis
from handover_marl.episode.spaces import (
    GIVER_ACTION_SIZE,
    check_giver_action,
    check_receiver_action,
    giver_action_space,
)
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.geometry.arrays import (
    NUMPY_ARRAYS,
    ONLY_ROW,
    AnyArray,
    AnyIndices,
    AnyIntegers,
    ArrayFactory,
    to_numpy,
)
from handover_marl.policies.policy import Action, Policy
from handover_marl.policies.populations import PopulationPolicy
from handover_marl.policies.reference import PolicyReference

#: Actions (r, ...), float32.
Actions: TypeAlias = AnyArray
#: Function that returns the observations (r, ...) in episodes, given the indices (r,) of these episodes.
ObserveFunction = Callable[[AnyIndices], Observation]


class PolicyBatch(ABC):
    """Policy that acts for one agent in n episodes; each action is held until the policy's next decision."""

    @abstractmethod
    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start an episode.

        Args:
            row: Index of the episode.
            seed: Seed of the policy in this episode.
            object_names: Class names of the objects; the first object is handed over.
        """

    @abstractmethod
    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...), new where a decision is due, else held, and the next decisions' physics steps (r,).

        Args:
            rows: Indices (r,) of the episodes.
            observe: Function that returns observations; called for the episodes in which a decision is due.
            steps: Physics steps (r,) since the start of each episode.
        """


class SequentialPolicyBatch(PolicyBatch):
    """Batch of n policies, one for each episode; they are called one after another.

    Args:
        policies: Policy of each episode.
        check: Function that checks an action and returns it as float32.
        arrays: Creator of the arrays that `act` returns; the policies themselves observe NumPy arrays.
    """

    def __init__(
        self,
        policies: Sequence[Policy],
        check: Callable[[object], npt.NDArray[np.float32]],
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        self._policies, self._check, self._arrays = policies, check, arrays
        self._actions: dict[int, npt.NDArray[np.float32]] = {}
        self._next_decision_steps = np.zeros(len(policies), dtype=np.int64)

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start episode `row` with the policy's seed and the class names of the objects; the first is handed over."""
        start_policy(self._policies[row], seed, object_names)
        self._next_decision_steps[row] = 0

    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...) in the episodes `rows`, and the physics steps (r,) of their next decisions."""
        arrays, rows, steps = self._arrays, to_numpy(rows), to_numpy(steps)
        numbers = np.flatnonzero(steps >= self._next_decision_steps[rows])
        found = observe(arrays.asarray(rows[numbers])) if len(numbers) else {}
        found = {key: to_numpy(values) for key, values in found.items()}
        for place, number in enumerate(numbers.tolist()):
            row, observation = int(rows[number]), {key: values[place] for key, values in found.items()}
            action, self._next_decision_steps[row] = call_policy(self._policies[row], observation, int(steps[number]))
            self._actions[row] = self._check(action)
        actions = np.stack([self._actions[row] for row in rows.tolist()])
        return arrays.asarray(actions), arrays.asarray(self._next_decision_steps[rows])


class ArrayPolicy(Policy):
    """Base class of policies that act in n episodes at once; a policy's state is in arrays (n, ...), a row per episode.

    Subclasses define `allocate`, `start` and `decide`. The constructor makes a policy for one episode, `copy_for` a
    policy for several; the actions in an episode must not depend on other episodes. Arrays are NumPy arrays or PyTorch
    tensors. The argument `rows` (r,) of methods has indices of episodes; observations and actions have one row for each
    of these r episodes.
    """

    _has_episode = False

    @abstractmethod
    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the policy's state for `count` episodes, in arrays that `arrays` creates."""

    @abstractmethod
    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`; `seed` determines the policy's random numbers in this episode."""

    @abstractmethod
    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the agent's actions (r, ...) in the episodes `rows`, given its observations (r, ...)."""

    def count_hold_steps(self, rows: AnyIndices) -> int | AnyIntegers:
        """Return for how many physics steps actions in the episodes `rows` are held: (r,), or one number for all."""
        return steps_from_hold_time(self.hold_time)

    @property
    def is_batchable(self) -> bool:
        """Whether `copy_for` may be used: False if a subclass overrides `act` or `reset`."""
        return (type(self).act, type(self).reset) == (ArrayPolicy.act, ArrayPolicy.reset)

    def copy_for(self, count: int, arrays: ArrayFactory) -> "ArrayPolicy":
        """Return a policy for `count` episodes with the same options; its state is in arrays that `arrays` creates."""
        policy = copy.copy(self)
        policy.allocate(count, arrays)
        return policy

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode of a policy with one row; the seed determines the policy's random numbers."""
        self._has_episode = True
        self.start(0, seed)

    def act(self, observation: Observation) -> Action:
        """Return the action of a policy with one row, (8,) of a giver or (9,) of a receiver."""
        if not self._has_episode:
            raise ResetNeededError(f"{self.agent} {self.name!r} cannot act before reset(); call reset() first")
        if self.agent in observation:
            raise OptionError(
                f"act needs the observation of the {self.agent}, got those of both agents; pass "
                f"observations[{self.agent!r}]"
            )
        action: Action = self.decide(ONLY_ROW, add_episode_axis(observation))[0]
        return action


class ArrayPolicyBatch(PolicyBatch):
    """Batch with one policy, which computes the actions of all episodes as arrays.

    Args:
        policy: Policy of n episodes.
        count: Number n of episodes.
        agent: Agent that acts, "giver" or "receiver".
        arrays: Creator of the arrays.
    """

    def __init__(self, policy: ArrayPolicy, count: int, agent: str, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._policy, self._arrays = policy, arrays
        self._actions = arrays.zeros((count, GIVER_ACTION_SIZE if agent == "giver" else PANDA_DOF), "float32")
        self._next_decision_steps = arrays.zeros(count, "int64")

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start episode `row` with the policy's seed and the class names of the objects; the first is handed over."""
        self._next_decision_steps[row] = 0
        self._policy.prepare(object_names)
        self._policy.start(row, seed)

    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...) in the episodes `rows`, and the physics steps (r,) of their next decisions."""
        numbers = self._arrays.xp.nonzero(steps >= self._next_decision_steps[rows])[0]
        if len(numbers):
            deciding = rows[numbers]
            self._actions[deciding] = self._policy.decide(deciding, observe(deciding))
            self._next_decision_steps[deciding] = steps[numbers] + self._policy.count_hold_steps(deciding)
        return self._actions[rows], self._next_decision_steps[rows]


def make_giver_actions(
    count: int,
    rate: float | AnyArray = 0.0,
    displacement: float | AnyArray = 0.0,
    rotation: float | AnyArray = 0.0,
    release: float | AnyArray = 0.0,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> Actions:
    """Make actions (r, 8) of r = `count` givers; see `handover_marl.policies.policy.make_giver_action`.

    Playback rates and releases are (r,) or one for all; displacements (m) and rotations (rad) are (r, 3) or 0.
    """
    actions = arrays.zeros((count, GIVER_ACTION_SIZE), "float32")
    actions[:, 0], actions[:, 1:4], actions[:, 4:7], actions[:, 7] = rate, displacement, rotation, release
    return actions


class PopulationBatch(PolicyBatch):
    """Policy batch of a population: in each episode, a randomly drawn member acts.

    `batches` has a policy batch for each member of `policy`, in this order; each is for all `count` episodes.
    """

    def __init__(
        self, policy: PopulationPolicy, batches: Sequence[PolicyBatch], count: int, arrays: ArrayFactory = NUMPY_ARRAYS
    ) -> None:
        self._policy, self._batches, self._arrays = policy, batches, arrays
        self._numbers = np.zeros(count, dtype=np.int_)

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start an episode with the member that the seed draws; see `PolicyBatch.reset`."""
        number, member_seed = self._policy.draw_member(seed)
        self._numbers[row] = number
        self._batches[number].reset(row, member_seed, object_names)

    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...) and physics steps (r,) of the next decisions; see `PolicyBatch.act`."""
        arrays, numbers = self._arrays, self._numbers[to_numpy(rows)]
        groups = [np.flatnonzero(numbers == number) for number in np.unique(numbers)]
        found = []
        for group in groups:
            group_rows = arrays.asarray(group)
            found.append(self._batches[numbers[group[0]]].act(rows[group_rows], observe, steps[group_rows]))
        order = arrays.asarray(np.argsort(np.concatenate(groups)))
        actions, next_steps = (arrays.xp.concat(list(parts))[order] for parts in zip(*found, strict=True))
        return actions, next_steps


def make_policy_batch(
    reference: PolicyReference,
    dataset: Dataset,
    config: WorldConfig,
    setup: str | None,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> PolicyBatch:
    """Make the policy batch of `count` episodes: one `ArrayPolicy` if it is batchable, else a policy for each episode.

    For a population, this applies to each member. Other arguments are those of `PolicyReference.make`.
    """
    agent, space = reference.agent, giver_action_space(config.giver)

    def check(action: object) -> npt.NDArray[np.float32]:
        return check_giver_action(action, space) if agent == "giver" else check_receiver_action(action)

    def make_batch(make: Callable[[], Policy]) -> PolicyBatch:
        first = make()
        if isinstance(first, PopulationPolicy):
            makers = [functools.partial(first.make_member, number) for number in range(len(first.members))]
            return PopulationBatch(first, [make_batch(maker) for maker in makers], count, arrays)
        if isinstance(first, ArrayPolicy) and first.is_batchable:
            return ArrayPolicyBatch(first.copy_for(count, arrays), count, agent, arrays)
        return SequentialPolicyBatch([first, *(make() for _ in range(count - 1))], check, arrays)

    return make_batch(functools.partial(reference.make, dataset, config, setup))
