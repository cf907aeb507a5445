"""Policies that act as a randomly drawn member of a population in each episode."""

from collections.abc import Sequence

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import STATE
from handover_marl.errors import OptionError
from handover_marl.policies.policy import Action, Giver, Policy, PolicyContext, Receiver
from handover_marl.policies.populations import DEFAULT_POPULATION, TRAIN, load_population
from handover_marl.policies.reference import parse_policy


class PopulationPolicy(Policy):
    """Base class of policies that act as a randomly drawn member of a population in each episode.

    The seed of the episode determines the member, and all members are equally likely.

    Args:
        context: Robot and task, for the members.
        population: Name of a shipped population, or path of a file; see `handover_marl.policies.populations`.
        partners: Families to draw from: "train", "test" or "all".
        trust: Whether code in policy files may run, and modules that the population names may be imported.

    Attributes:
        members: Policies of the members.

    Members that need the wrist camera are left out, since all members have the observations of this policy.

    Raises:
        OptionError: No member of the split acts on the state.
        HandoverError: The same errors as `load_population`.
    """

    name = "population"
    file_options = ("population",)

    def __init__(
        self,
        context: PolicyContext | None = None,
        population: str = DEFAULT_POPULATION,
        partners: str = TRAIN,
        trust: bool = False,
    ) -> None:
        super().__init__(context)
        self._given_context = context
        agent, found = str(self.agent), load_population(population, trust)
        self._content_hash = found.content_hash
        chosen = found.select(agent, partners)
        references = [parse_policy(agent, found.get_policy(partner), trust) for partner in chosen]
        self._references = [one for one in references if one.policy_class.obs_mode == STATE]
        if not self._references:
            raise OptionError(f"population must have {agent}s that act on the state, got none in {population!r}")
        self.members = [self.make_member(number) for number in range(len(self._references))]
        self._member = self.members[0]

    @property
    def weights_hash(self) -> str:
        """Hash of the population."""
        return self._content_hash

    @property
    def hold_time(self) -> float:
        """Time (s) for which the current member's action is held."""
        return self._member.hold_time

    def prepare(self, object_names: Sequence[str]) -> None:
        """Prepare all members for episodes with these objects."""
        for member in self.members:
            member.prepare(object_names)

    def make_member(self, number: int) -> Policy:
        """Return a new policy that acts as the member with this index."""
        return self._references[number].make_from_context(self._given_context)

    def draw_member(self, seed: int | None) -> tuple[int, int]:
        """Return the index of an episode's member, and the seed of the member."""
        rng = np.random.default_rng(seed)
        return int(rng.integers(len(self.members))), int(rng.integers(2**32))

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with the member that the seed draws."""
        number, member_seed = self.draw_member(seed)
        self._member = self.members[number]
        self._member.reset(member_seed)

    def act(self, observation: Observation) -> Action:
        """Return the action of the current member."""
        return self._member.act(observation)


class PopulationGiver(PopulationPolicy, Giver):
    """Giver that acts as a randomly drawn giver of a population in each episode; see `PopulationPolicy`."""


class PopulationReceiver(PopulationPolicy, Receiver):
    """Receiver that acts as a randomly drawn receiver of a population in each episode; see `PopulationPolicy`."""
