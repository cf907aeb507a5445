"""Policies that run one dense network in many episodes at once.

For equal features, the outputs of the network equal those of a single policy to the bit. Features and action schemes
of a batch differ from single ones by up to 1e-6, so that actions equal those of single policies to 1e-5. Actions do
not depend on the other episodes of the batch.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.learning.adapters.function_policy import FunctionPolicy
from handover_marl.learning.adapters.network_policy import NetworkPolicy
from handover_marl.learning.batch.encodings import find_scheme_batch
from handover_marl.learning.batch.features import FEATURE_BATCHES, FeatureBatch
from handover_marl.learning.batch.schemes import SchemeBatch
from handover_marl.learning.learned_policy import LearnedPolicy
from handover_marl.learning.policy_spec import DenseNetwork
from handover_marl.policies.batch import ArrayPolicy, PolicyBatch
from handover_marl.policies.policy import Policy
from handover_marl.receivers.grasp_library import get_nearest_grasp_selector
from handover_marl.receivers.grasp_selection import GraspSelectionBatch

Actions = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]


class NetworkPolicyBatch(ArrayPolicy[NetworkPolicy]):
    """Batch of policies that evaluate one network, for all episodes in one call.

    Args:
        policy: Policy of a single episode, whose function is a `DenseNetwork`.
        features: Features of n episodes.
        scheme: Action scheme of n episodes.
        count: Number n of episodes.
        check: Function that checks an action that is not finite, and raises an error.
    """

    def __init__(
        self,
        policy: NetworkPolicy,
        features: FeatureBatch,
        scheme: SchemeBatch,
        count: int,
        check: Callable[[object], Actions],
    ) -> None:
        super().__init__(policy, count, policy.scheme.agent)
        self._features, self._scheme, self._check = features, scheme, check

    def start(self, row: int, seed: int | None) -> None:
        """Clear the state of the previous episode."""
        self._features.reset(row)
        self._scheme.reset(row)

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, ...); evaluate the network for episodes whose action scheme needs outputs.

        Raises:
            ActionError: An action, or an output of an adapted policy, is not finite.
        """
        needs = np.flatnonzero(self._scheme.needs_outputs(rows, observation))
        if len(needs):
            inputs = self._features(rows[needs], {key: values[needs] for key, values in observation.items()})
            self._scheme.set_outputs(rows[needs], self._evaluate(inputs))
        actions = self._scheme.compute_actions(rows, observation)
        for number in np.flatnonzero(~np.isfinite(actions).all(axis=1)):
            self._check(actions[number])
        return actions

    def _evaluate(self, inputs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        outputs: npt.NDArray[np.float32] = self._policy.function(inputs)
        for number in np.flatnonzero(~np.isfinite(outputs).all(axis=1)):
            outputs[number] = self._policy.evaluate(inputs[number])
        return outputs


def make_network_policy_batch(policy: Policy, count: int, check: Callable[[object], Actions]) -> PolicyBatch | None:
    """Return the batch of a policy with a dense network, built-in features and a built-in action scheme.

    Args:
        policy: Policy of a single episode.
        count: Number of episodes.
        check: Function that checks an action.

    Returns:
        The batch, or None for other policies: PyTorch modules, graphs and user-defined encodings are evaluated
        episode by episode.
    """
    # A subclass may act in another way, so it has no batch.
    if not isinstance(policy, NetworkPolicy) or type(policy) not in (LearnedPolicy, FunctionPolicy):
        return None
    if not isinstance(policy.function, DenseNetwork):
        return None
    context = policy.scheme.context
    selection = GraspSelectionBatch(get_nearest_grasp_selector(context), count)
    scheme = find_scheme_batch(policy.scheme, selection, count)
    known = FEATURE_BATCHES[policy.scheme.agent].get(policy.features) if isinstance(policy.features, str) else None
    if known is None or scheme is None:
        return None
    return NetworkPolicyBatch(policy, known(context, selection, count), scheme, count, check)
