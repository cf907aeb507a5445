"""Policies that act in many episodes at once, as one policy on arrays or as one policy per episode.

Policies on arrays work with NumPy arrays or with PyTorch tensors; `HostPolicyBatch` lets policies on NumPy arrays act
in episodes whose arrays are tensors.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

import numpy as np

from handover_marl.config import PANDA_DOF
from handover_marl.episode.loop import call_policy, start_policy
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, AnyIntegers, ArrayFactory, to_numpy
from handover_marl.policies.policy import Policy

#: Actions (r, ...), float32.
Actions: TypeAlias = AnyArray
#: Function that returns the observations (r, ...) in the episodes with given indices (r,).
ObserveFunction = Callable[[AnyIndices], Observation]


class PolicyBatch(ABC):
    """Policy that acts for one agent in n episodes; an action is held until the policy's next decision."""

    @abstractmethod
    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start an episode.

        Args:
            row: Index of the episode.
            seed: Seed of the policy in this episode.
            object_names: Class names of the objects, the one that is handed over first.
        """

    @abstractmethod
    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...), new ones where a decision is due, and the physics steps (r,) of the next decisions.

        Args:
            rows: Indices (r,) of the episodes.
            observe: Function that returns the observations of some episodes; called for episodes with a decision.
            steps: Physics steps (r,) since the start of each episode.
        """


class SequentialPolicyBatch(PolicyBatch):
    """Batch of n policies, one for each episode, that are called one after another.

    Args:
        policies: Policy of each episode.
        check: Function that checks an action and returns it as float32.
    """

    def __init__(self, policies: Sequence[Policy], check: Callable[[object], Actions]) -> None:
        self._policies, self._check = policies, check
        self._actions: dict[int, Actions] = {}
        self._due = np.zeros(len(policies), dtype=np.int64)

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start episode `row` with a seed of the policy and the objects' class names, the handed-over one first."""
        start_policy(self._policies[row], seed, object_names)
        self._due[row] = 0

    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...) in the episodes `rows`, and the physics steps (r,) of their next decisions."""
        numbers = np.flatnonzero(steps >= self._due[rows])
        found = observe(rows[numbers]) if len(numbers) else {}
        for place, number in enumerate(numbers.tolist()):
            row, observation = int(rows[number]), {key: values[place] for key, values in found.items()}
            action, self._due[row] = call_policy(self._policies[row], observation, int(steps[number]))
            self._actions[row] = self._check(action)
        return np.stack([self._actions[row] for row in rows.tolist()]), self._due[rows]


class HostPolicyBatch(PolicyBatch):
    """Adapter that runs a batch of NumPy policies in episodes on a GPU: copies observations to the CPU, actions back.

    Args:
        batch: Batch of policies that takes and returns NumPy arrays.
        arrays: Creator of the tensors into which actions are converted, on the device of the episodes.
    """

    def __init__(self, batch: PolicyBatch, arrays: ArrayFactory) -> None:
        self._batch, self._arrays = batch, arrays

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start episode `row` with a seed of the policy and the objects' class names, the handed-over one first."""
        self._batch.reset(row, seed, object_names)

    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...) in the episodes `rows`, and the physics steps (r,) of their next decisions."""

        def observe_on_host(some: AnyIndices) -> Observation:
            return {key: to_numpy(values) for key, values in observe(self._arrays.asarray(some)).items()}

        actions, due = self._batch.act(to_numpy(rows), observe_on_host, to_numpy(steps))
        return self._arrays.asarray(actions), self._arrays.asarray(due)


class ArrayPolicy(Protocol):
    """Interface of policies whose state is in arrays (n, ...), one row for each of n episodes.

    The argument `rows` (r,) of methods has the indices of the episodes to which a method applies.
    """

    def prepare(self, object_names: Sequence[str]) -> None:
        """Prepare for an episode with the objects of these class names."""

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`, whose random numbers `seed` determines."""

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the agent's actions (r, ...) in the episodes `rows`, given its observations (r, ...)."""

    def count_hold_steps(self, rows: AnyIndices) -> int | AnyIntegers:
        """Return for how many physics steps the actions in the episodes `rows` are held, (r,) or one number for all."""


class ArrayPolicyBatch(PolicyBatch):
    """Batch of a policy that computes the actions of all episodes as arrays.

    Args:
        policy: Policy of n episodes.
        count: Number n of episodes.
        agent: Agent that acts, "giver" or "receiver".
        arrays: Creator of the arrays.
    """

    def __init__(self, policy: ArrayPolicy, count: int, agent: str, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._policy, self._arrays = policy, arrays
        self._actions = arrays.zeros((count, GIVER_ACTION_SIZE if agent == "giver" else PANDA_DOF), "float32")
        self._due = arrays.zeros(count, "int64")

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start episode `row` with a seed of the policy and the objects' class names, the handed-over one first."""
        self._due[row] = 0
        self._policy.prepare(object_names)
        self._policy.start(row, seed)

    def act(self, rows: AnyIndices, observe: ObserveFunction, steps: AnyIntegers) -> tuple[Actions, AnyIntegers]:
        """Return actions (r, ...) in the episodes `rows`, and the physics steps (r,) of their next decisions."""
        numbers = self._arrays.xp.nonzero(steps >= self._due[rows])[0]
        if len(numbers):
            due = rows[numbers]
            self._actions[due] = self._policy.decide(due, observe(due))
            self._due[due] = steps[numbers] + self._policy.count_hold_steps(due)
        return self._actions[rows], self._due[rows]


def make_giver_actions(
    count: int,
    rate: float | AnyArray = 0.0,
    displacement: float | AnyArray = 0.0,
    rotation: float | AnyArray = 0.0,
    release: float | AnyArray = 0.0,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> Actions:
    """Make actions (r, 8) of r givers from their components; see `handover_marl.policies.policy.make_giver_action`.

    Args:
        count: Number r of givers.
        rate: Playback rates minus 1, (r,) or one for all.
        displacement: Set-points (r, 3) of the wrists' displacements, world frame (m), or 0.
        rotation: Set-points (r, 3) of the rotation vectors about the wrists, world frame (rad), or 0.
        release: Whether to release the objects, (r,) or one value for all; 1 is yes.
        arrays: Creator of the array.
    """
    actions = arrays.zeros((count, GIVER_ACTION_SIZE), "float32")
    actions[:, 0], actions[:, 1:4], actions[:, 4:7], actions[:, 7] = rate, displacement, rotation, release
    return actions
