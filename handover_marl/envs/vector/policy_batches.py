"""Creation of the policies that act in many environments at once."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import WorldConfig
from handover_marl.datasets.dataset import Dataset
from handover_marl.episode.spaces import check_giver_action, check_receiver_action, giver_action_space
from handover_marl.givers.batch import make_giver_batch
from handover_marl.learning.batch.network_policies import make_network_policy_batch
from handover_marl.policies.batch import PolicyBatch, SequentialPolicyBatch
from handover_marl.policies.reference import PolicyReference


def make_policy_batch(
    reference: PolicyReference, dataset: Dataset, config: WorldConfig, setup: str | None, count: int
) -> PolicyBatch:
    """Make a policy for n environments: on arrays if there is such a version, else one per environment.

    Args:
        reference: Policy.
        dataset: Robot model, objects and grasps for the policy.
        config: World and rules for the policy.
        setup: Official setup that is played.
        count: Number n of environments.

    Raises:
        PolicyError: The constructor of the policy fails.
    """
    first = reference.make(dataset, config, setup)
    space = giver_action_space(config.giver)

    def check(action: object) -> npt.NDArray[np.float32]:
        return check_giver_action(action, space) if reference.agent == "giver" else check_receiver_action(action)

    batch = make_giver_batch(first, count) or make_network_policy_batch(first, count, check)
    if batch is not None:
        return batch
    return SequentialPolicyBatch([first, *(reference.make(dataset, config, setup) for _ in range(count - 1))], check)
