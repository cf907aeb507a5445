"""One live agent: the other one is frozen to a policy."""

from typing import Any, Literal, TypeVar, overload

from gymnasium.utils import EzPickle

from handover_marl.envs.arguments import AGENTS, GIVER, RECEIVER
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrapper import ParallelStep, ParallelWrapper, SingleAgentEnv
from handover_marl.episode.clock import PolicyClock
from handover_marl.episode.observations import Observation
from handover_marl.errors import ActionError, OptionError, ResetNeededError, UnknownNameError
from handover_marl.policies.reference import PolicyLike, policy_reference

DEFAULT_PARTNERS = {RECEIVER: "replay", GIVER: "yang2021"}


class FrozenPartnerEnv(ParallelWrapper):
    """A parallel environment with one live agent. Made by `freeze`.

    Args:
        env: Two agents, of which the partner sees and does what `HandoverEnv` says.
        agent: The live one.
        partner: The other one's policy; default: "replay" for a giver, "yang2021" for a receiver.
        trust: Whether code in a policy file may run.

    Raises:
        UnknownNameError: No such agent or policy.
        OptionError: The environment has no such two agents.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_frozen_partner_v0"}

    def __init__(
        self,
        env: HandoverEnv | ParallelWrapper,
        agent: str = RECEIVER,
        partner: PolicyLike | None = None,
        trust: bool = False,
    ) -> None:
        EzPickle.__init__(self, env, agent, partner, trust)
        if agent not in AGENTS:
            raise UnknownNameError("agent", agent, AGENTS)
        super().__init__(env, [agent])
        self.live_agent = agent
        self.partner_agent = GIVER if agent == RECEIVER else RECEIVER
        if self.partner_agent not in env.possible_agents or agent not in env.possible_agents:
            raise OptionError(f"only {' and '.join(env.possible_agents)} is left in this environment")
        plain = self.world.observation_space(self.partner_agent)
        if env.observation_space(self.partner_agent) != plain:
            raise OptionError(
                f"the {self.partner_agent} is encoded already, but policies see what HandoverEnv shows; freeze first, "
                "then encode"
            )
        chosen = DEFAULT_PARTNERS[agent] if partner is None else partner
        reference = policy_reference(self.partner_agent, chosen, trust)
        self._policy = reference.make(self.world.dataset, self.world.config, self.world.setup)
        self._partner = PolicyClock(self._policy)
        self._steps = 0

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
        """As `HandoverEnv.reset`, for the live agent; every episode has a partner's seed of its own."""
        self._seed(seed)
        observations, infos = self.env.reset(seed, options)
        self._partner.reset(int(self.np_random.integers(2**32)), self.world.object_names)
        self._steps = 0
        return self._mine(observations), self._mine(infos)

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """As `HandoverEnv.step`, for the live agent; the partner acts on what it saw last.

        Raises:
            ActionError: The live agent's action is missing or malformed, or there is another agent's.
            ResetNeededError: No episode is running.
            PolicyError: The partner fails.
        """
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        if not isinstance(actions, dict) or actions.keys() - {self.live_agent}:
            raise ActionError(f"step() takes a dict with an action for {self.live_agent}, the one live agent")
        observations, rewards, ended, timed_out, infos = self.env.step(
            {
                self.live_agent: actions.get(self.live_agent),
                self.partner_agent: self._partner.act(self._shown, self._steps),
            }
        )
        self._steps = int(infos[self.partner_agent]["steps"])
        mine = self._mine
        return mine(observations), mine(rewards), mine(ended), mine(timed_out), mine(infos)

    def _shown(self) -> Observation:
        """What the partner sees: what it asks for, whatever a learner in its place would be shown."""
        return self.world.observation_for(self.partner_agent, self._policy)

    def _mine(self, by_agent: dict[str, Any]) -> dict[str, Any]:
        return {self.live_agent: by_agent[self.live_agent]}


@overload
def freeze(
    env: HandoverEnv | ParallelWrapper,
    agent: str = RECEIVER,
    partner: PolicyLike | None = None,
    *,
    api: Literal["parallel"] = "parallel",
    trust: bool = False,
) -> FrozenPartnerEnv: ...


@overload
def freeze(
    env: HandoverEnv | ParallelWrapper,
    agent: str = RECEIVER,
    partner: PolicyLike | None = None,
    *,
    api: Literal["gymnasium"],
    trust: bool = False,
) -> SingleAgentEnv: ...


def freeze(
    env: HandoverEnv | ParallelWrapper,
    agent: str = RECEIVER,
    partner: PolicyLike | None = None,
    *,
    api: Literal["parallel", "gymnasium"] = "parallel",
    trust: bool = False,
) -> FrozenPartnerEnv | SingleAgentEnv:
    """Leave one agent live and freeze the other one to a policy.

    Args:
        env: `handover_marl.parallel_env(...)`, or a wrapper of it that still has both agents.
        agent: The live one, "receiver" or "giver".
        partner: The other one's policy: a name, a class, an instance; default: "replay" or "yang2021".
        api: "parallel" makes a PettingZoo environment of one agent, "gymnasium" a Gymnasium one.
        trust: Whether code in a policy file (`learned:FILE`) may run.

    Raises:
        UnknownNameError: No such agent, policy or api.
        OptionError: The partner cannot be frozen in this environment.
    """
    return as_api(FrozenPartnerEnv(env, agent, partner, trust), api)


_Env = TypeVar("_Env", bound=ParallelWrapper)


def as_api(env: _Env, api: str) -> _Env | SingleAgentEnv:
    """A parallel environment as it is, or as a Gymnasium one.

    Raises:
        UnknownNameError: There is no such API.
        OptionError: A Gymnasium environment is wanted of several agents.
    """
    if api not in ("parallel", "gymnasium"):
        raise UnknownNameError("api", api, ("parallel", "gymnasium"))
    return env if api == "parallel" else SingleAgentEnv(env)
