"""Policies that run one dense network in many episodes at once.

Actions equal those of single policies to the bit and do not depend on the other episodes of the batch. For PyTorch
tensors, they equal those of single policies to 1e-5.
"""

from collections.abc import Callable, Sequence
from typing import Any

from handover_marl.episode.loop import steps_from_hold_time
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, ArrayFactory, to_numpy
from handover_marl.learning.adapters.function_policy import FunctionPolicy
from handover_marl.learning.custom_encodings import CustomScheme
from handover_marl.learning.features import list_features, make_array_features
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.learning.policy_spec import DenseNetwork
from handover_marl.learning.schemes import make_array_scheme
from handover_marl.policies.batch import Actions
from handover_marl.policies.policy import Policy


class NetworkArrayPolicy:
    """Policy on arrays (n, ...) that evaluates one network for several of n episodes in one call; see `ArrayPolicy`.

    Args:
        policy: Policy of a single episode, whose function is a `DenseNetwork`, with built-in features and scheme.
        count: Number n of episodes.
        check: Function that is called with an action that is not finite, and raises an error.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.
    """

    def __init__(
        self, policy: FunctionPolicy, count: int, check: Callable[[object], Actions], arrays: ArrayFactory
    ) -> None:
        agent, context, spec = policy.scheme.agent, policy.scheme.context, policy.spec
        self._policy, self._arrays, self._hold_steps = policy, arrays, steps_from_hold_time(policy.hold_time)
        self._check = check
        selector = LowestCostGraspSelector(context, count, arrays)
        self._features = make_array_features(agent, spec.features, context, selector, count, arrays)
        self._scheme = make_array_scheme(agent, policy.scheme.name, context, selector, count, arrays)
        self._scheme.wait = policy.scheme.wait
        network: Any = policy.function
        self._network: DenseNetwork = network.copy_to(arrays)

    def prepare(self, object_names: Sequence[str]) -> None:
        """Do nothing: a network needs no preparation for the objects with these names."""

    def count_hold_steps(self, rows: AnyIndices) -> int:
        """Return the number of physics steps for which each action is held, the same for all episodes `rows`."""
        return self._hold_steps

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode: clear what features and action scheme stored at index `row`; `seed` is not used."""
        self._features.reset(row)
        self._scheme.reset(row)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return actions (r, 8) or (r, 9) of the episodes with indices `rows`; evaluate the network where needed.

        Raises:
            ActionError: An action, or an output of an adapted policy, is not finite.
        """
        needs = self._arrays.xp.nonzero(self._scheme.needs_outputs(rows, observation))[0]
        if len(needs):
            inputs = self._features(rows[needs], {key: values[needs] for key, values in observation.items()})
            self._scheme.set_outputs(rows[needs], self._evaluate(inputs))
        actions = self._scheme.compute_actions(rows, observation)
        for number in self._find_not_finite(actions):
            self._check(to_numpy(actions[number]))
        return actions

    def _evaluate(self, inputs: AnyArray) -> AnyArray:
        outputs = self._network(inputs)
        for number in self._find_not_finite(outputs):
            outputs[number] = self._arrays.asarray(self._policy.evaluate(to_numpy(inputs[number])))
        return outputs

    def _find_not_finite(self, vectors: AnyArray) -> list[int]:
        """Return the indices of those of r vectors, (r, k), that have a number that is not finite."""
        xp = self._arrays.xp
        found: list[int] = xp.nonzero(~xp.all(xp.isfinite(vectors), axis=1))[0].tolist()
        return found


def make_network_array_policy(
    policy: Policy, count: int, check: Callable[[object], Actions], arrays: ArrayFactory = NUMPY_ARRAYS
) -> NetworkArrayPolicy | None:
    """Convert a policy of one episode to a policy of n episodes, which runs on arrays.

    Args:
        policy: Policy of a single episode.
        count: Number n of episodes.
        check: Function that is called with an action that is not finite, and raises an error.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.

    Returns:
        The policy on arrays; None unless `policy` has a dense network, built-in features and a built-in action
        scheme. Other policies, e.g. with a PyTorch module, are evaluated episode by episode.
    """
    # A subclass may act in another way.
    if not isinstance(policy, FunctionPolicy) or type(policy).act is not FunctionPolicy.act:
        return None
    is_own_features = policy.spec.features not in list_features(policy.scheme.agent)
    is_own_scheme = isinstance(policy.scheme.scheme, CustomScheme)
    if is_own_features or is_own_scheme or not isinstance(policy.function, DenseNetwork):
        return None
    return NetworkArrayPolicy(policy, count, check, arrays)
