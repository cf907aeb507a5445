"""Creation of the policies that act in many environments at once."""

import functools
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import WorldConfig
from handover_marl.datasets.dataset import Dataset
from handover_marl.episode.spaces import check_giver_action, check_receiver_action, giver_action_space
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyIndices, AnyIntegers, ArrayFactory, to_numpy
from handover_marl.policies.batch import (
    Actions,
    ArrayPolicy,
    ArrayPolicyBatch,
    ObserveFunction,
    PolicyBatch,
    SequentialPolicyBatch,
)
from handover_marl.policies.policy import Policy
from handover_marl.policies.populations import PopulationPolicy
from handover_marl.policies.reference import PolicyReference


class PopulationBatch(PolicyBatch):
    """Policy batch of a population, from which each episode draws the member policy that acts in it.

    The argument `batches` has the policy batch of each member of `policy`, for all `count` episodes.
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
    """Make the policy batch of `count` environments: one policy on arrays if possible, else one policy for each."""
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
