"""Wrapper in which one agent is controlled from outside; a fixed policy acts for the other agent."""

from typing import Any

from gymnasium.utils import EzPickle, seeding

from handover_marl.envs.agents import AGENTS, GIVER, RECEIVER
from handover_marl.envs.handover_env import HandoverEnv, check_seed
from handover_marl.envs.wrappers.wrapper import Api, ByAgent, ParallelStep, ParallelWrapper, WrappableEnv, convert_api
from handover_marl.errors import ActionError, OptionError, check_name
from handover_marl.policies.reference import PolicyLike, parse_policy

DEFAULT_PARTNERS = {RECEIVER: "replay", GIVER: "yang2021"}


class FixedPartnerEnv(ParallelWrapper):
    """Parallel environment of one agent, made by `control_agent`; a fixed policy acts for the other agent.

    The partner acts as in evaluations, at its own control period, which may differ from the environment's. Each reset
    draws a run seed, from which the partner's seed is derived. Wrappers of `env` change neither the partner's
    observations nor its actions.

    Attributes:
        controlled_agent: Agent that is controlled from outside, "receiver" or "giver".
        partner_agent: Agent that the partner policy acts for.
        reference: Reference to the partner's policy, which can make more instances of the policy.
        policy: Policy of the partner.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_fixed_partner_v0"}

    def __init__(
        self, env: WrappableEnv, agent: str = RECEIVER, partner: PolicyLike | None = None, trust: bool = False
    ) -> None:
        check_name("agent", agent, AGENTS)
        super().__init__(env, [agent])
        EzPickle.__init__(self, env, agent, partner, trust)
        self.controlled_agent = agent
        self.partner_agent = GIVER if agent == RECEIVER else RECEIVER
        if set(env.possible_agents) != set(AGENTS):
            raise OptionError(f"env must have both agents, got only {' and '.join(env.possible_agents)}")
        base = self.unwrapped
        if env.observation_space(self.partner_agent) != base.observation_space(self.partner_agent):
            raise OptionError(
                f"observations of the {self.partner_agent} must not be encoded, because a policy acts for it; "
                "call control_agent() first, then encode()"
            )
        chosen = DEFAULT_PARTNERS[agent] if partner is None else partner
        self.reference = parse_policy(self.partner_agent, chosen, trust)
        self.policy = self.reference.make(base.dataset, base.config.world_config, base.config.setup)
        self._rng, _ = seeding.np_random(None)

    def reset(self, seed: int | None = None, options: ByAgent | None = None) -> tuple[ByAgent, ByAgent]:
        """Start an episode with a new run seed for the partner; return observation and info by agent.

        Arguments and result are as in `HandoverEnv.reset`, without the entries of the partner.
        """
        if seed is not None:
            self._rng, _ = seeding.np_random(check_seed(seed))
        results = self.env.reset(seed=seed, options=options)
        self.unwrapped.set_partner(self.partner_agent, self.policy, int(self._rng.integers(2**32)))
        observations, infos = ({self.controlled_agent: by_agent[self.controlled_agent]} for by_agent in results)
        return observations, infos

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """Let both agents act for one control period; the partner's policy decides at its own control period.

        The result is as in `HandoverEnv.step`, without the entries of the partner.

        Args:
            actions: `{agent: action}` of the agent that is controlled from outside.
        """
        live, partner = self.controlled_agent, self.partner_agent
        if not isinstance(actions, dict) or actions.keys() - {live}:
            raise ActionError(
                f"actions must be a dict with one action, for the {live}; a policy acts for the {partner}"
            )
        results = self.env.step({live: actions.get(live), partner: self.unwrapped.act_for_partner()})
        observations, rewards, terminations, truncations, infos = ({live: by_agent[live]} for by_agent in results)
        return observations, rewards, terminations, truncations, infos


def control_agent(
    env: WrappableEnv,
    agent: str = RECEIVER,
    partner: PolicyLike | None = None,
    *,
    api: Api = "parallel",
    trust: bool = False,
) -> Any:
    """Return an environment in which one agent is controlled from outside; a fixed policy acts for the other agent.

    Args:
        env: `handover_marl.parallel_env(...)`, or a wrapper of it that has both agents. The partner
            observes what the environment itself returns, unchanged by wrappers.
        agent: Agent that is controlled from outside, "receiver" or "giver".
        partner: Policy of the other agent: a name, a class or an instance; default: "replay" for a
            giver, "yang2021" for a receiver.
        api: "parallel" for a PettingZoo environment of one agent, "gymnasium" for a Gymnasium one.
        trust: Whether modules that a policy file (`learned:FILE`) or a population names may be imported.

    Raises:
        UnknownNameError: There is no such agent, policy or API.
        OptionError: `env` does not have both agents, or encodes the partner's observations.
    """
    return convert_api(FixedPartnerEnv(env, agent, partner, trust), api)
