"""Factory that lists and creates the registered policies of one agent."""

from typing import Generic, TypeVar, cast

from handover_marl.datasets import Dataset
from handover_marl.policies import registry
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike, parse_policy

_Policy = TypeVar("_Policy", bound=Policy)


class PolicyFactory(Generic[_Policy]):
    """Factory of the policies of one agent.

    Args:
        agent: "giver" or "receiver".
    """

    def __init__(self, agent: str) -> None:
        self._agent = agent

    def list_available(self) -> tuple[str, ...]:
        """Return the names of the registered policies."""
        return registry.list_available(self._agent)

    def make(
        self, policy: PolicyLike, dataset: Dataset | None = None, trust: bool = False, setup: str | None = None
    ) -> _Policy:
        """Create a policy for the robot and objects of a dataset.

        Args:
            policy: Registered name, with options or a file, or a class; see
                `handover_marl.policies.reference`.
            dataset: Dataset with the robot and objects; default: the one `open_dataset()` returns.
            trust: Whether code in a policy file may be executed.
            setup: Setup whose weights a learned policy uses; default: the first of the dataset.

        Raises:
            UnknownNameError: No policy of this name is registered for the agent.
            HandoverError: The policy cannot be created, or its policy file cannot be loaded.
        """
        return cast(_Policy, parse_policy(self._agent, policy, trust).make(dataset, setup=setup))
