"""Labels that the partners of a population have in results."""

from collections.abc import Sequence

from handover_marl.datasets import open_dataset
from handover_marl.errors import OptionError
from handover_marl.policies.populations import Partner, Population
from handover_marl.policies.reference import parse_policy


def list_labels(
    population: Population, agent: str, partners: Sequence[Partner], trust: bool = False
) -> dict[str, Partner]:
    """Return partners by the label that they have in result folders.

    Partners that cannot be made here, for example for lack of an optional package, are left out.

    Args:
        population: Population.
        agent: Agent of the partners, "giver" or "receiver".
        partners: Partners of this agent.
        trust: Whether code in policy files may run.
    """
    # Labels do not depend on the data set.
    dataset = open_dataset("synthetic")
    labels: dict[str, Partner] = {}
    for partner in partners:
        try:
            reference = parse_policy(agent, population.get_policy(partner), trust).resolve(dataset)
        except OptionError:
            continue
        labels[reference.label] = partner
    return labels


def find_wrong_labels(labels: dict[str, Partner], found: Sequence[tuple[Partner, str]]) -> list[str]:
    """Return the names of partners whose label in results is that of another policy.

    Args:
        labels: Partners by label.
        found: Partners and their labels in results.
    """
    expected = {partner.name: label for label, partner in labels.items()}
    return [partner.name for partner, label in found if expected.get(partner.name, label) != label]
