"""Vectors for observations and outputs within -1 and 1 for actions, as networks want them."""

from collections.abc import Mapping
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle

from handover_marl.envs.arguments import GIVER, RECEIVER
from handover_marl.envs.freeze import as_api
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrapper import ParallelStep, ParallelWrapper, SingleAgentEnv
from handover_marl.episode.observations import Observation
from handover_marl.errors import ActionError, OptionError, ResetNeededError
from handover_marl.learning.giver_schemes import GiverScheme
from handover_marl.learning.observing import make_features, n_features
from handover_marl.learning.schemes import make_scheme, scheme_size
from handover_marl.policies.context import context_of

Vector = npt.NDArray[np.float32]

#: What agents see and do unless told otherwise.
FEATURES = {GIVER: "giver", RECEIVER: "receiver"}
SCHEMES = {GIVER: "deviation", RECEIVER: "cartesian_delta"}
# Episodes that may end in a row before a scheme has asked for anything.
_PATIENCE = 100


class EncodedEnv(ParallelWrapper):
    """Features for observations, action schemes for actions. Made by `encode`.

    With one agent a step lasts until its scheme asks again, mostly one control period; rewards are added up
    meanwhile, and an episode in which nothing is asked is played out and another one begun. With two agents a step
    is one control period, and a scheme that does not ask keeps its last outputs.

    Args:
        env: What is encoded.
        features: Name of each agent's features.
        schemes: Name of each agent's action scheme.

    Raises:
        UnknownNameError: No such features or scheme.
        OptionError: An agent is named that is not there, or sees vectors already.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_encoded_v0"}

    def __init__(
        self,
        env: HandoverEnv | ParallelWrapper,
        features: Mapping[str, str] | None = None,
        schemes: Mapping[str, str] | None = None,
    ) -> None:
        EzPickle.__init__(self, env, features, schemes)
        super().__init__(env)
        agents = self.possible_agents
        vectors = [agent for agent in agents if not isinstance(env.observation_space(agent), spaces.Dict)]
        if vectors:
            raise OptionError(f"the {vectors[0]} sees vectors already; encode before flattening, and once")
        self.features_names = _names("features", FEATURES, features, agents)
        self.scheme_names = _names("schemes", SCHEMES, schemes, agents)
        context = context_of(self.world.dataset, self.world.config, self.world.setup)
        self._features = {agent: make_features(agent, self.features_names[agent], context) for agent in agents}
        self._schemes = {agent: make_scheme(agent, self.scheme_names[agent], context) for agent in agents}
        self._spaces = {
            agent: encoded_spaces(agent, self.features_names[agent], self.scheme_names[agent]) for agent in agents
        }
        for _, outputs in self._spaces.values():
            outputs.control_period = self.world.control_period  # type: ignore[attr-defined]
        self._seen: dict[str, Observation] = {}

    def observation_space(self, agent: str) -> spaces.Box:
        """The agent's features."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.Box:
        """The outputs that its scheme takes."""
        return self._spaces[agent][1]

    def observed(self, agent: str) -> Observation:
        """What an agent saw last, before it was made features of.

        Raises:
            ResetNeededError: There was no reset yet.
        """
        if agent not in self._seen:
            raise ResetNeededError("no episode is running; call reset() first")
        return self._seen[agent]

    def outputs_of(self, agent: str, action: Vector) -> Vector:
        """(size,) outputs that come nearest to an action of a giver now, to learn from other givers.

        Raises:
            OptionError: The action scheme cannot say.
        """
        scheme = self._schemes[agent]
        if not isinstance(scheme, GiverScheme):
            raise OptionError(f"action scheme {scheme.name!r} cannot imitate")
        return np.asarray(scheme.outputs(action, self.observed(agent)), dtype=np.float32)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Vector], dict[str, dict[str, float]]]:
        """Start an episode, and play it until outputs are wanted; `options={"scene_id": n}` chooses the scene."""
        for attempt in range(_PATIENCE):
            self._seen, infos = self.env.reset(seed if attempt == 0 else None, options)
            for scheme in self._schemes.values():
                scheme.reset()
            if len(self.possible_agents) > 1:
                return self._encoded(), infos
            while self.agents and not self._asks():
                self._seen, _, _, _, infos = self._once()
            if self.agents:
                return self._encoded(), infos
        raise OptionError(
            f"in {_PATIENCE} episodes in a row nothing was asked of the {self.possible_agents[0]} before the end; "
            "choose another partner or action scheme"
        )

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """Let the agents act until they are asked again or the episode ends.

        Args:
            actions: Each agent's outputs, elements of the action spaces.

        Raises:
            ActionError: One is missing or malformed.
            ResetNeededError: No episode is running.
        """
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        outputs = {agent: self._checked(agent, actions) for agent in self.agents}
        for agent, scheme in self._schemes.items():
            if scheme.asks(self._seen[agent]):
                scheme.decide(outputs[agent])
        self._seen, rewards, ended, timed_out, infos = self._once()
        while len(self.possible_agents) == 1 and self.agents and not self._asks():
            before = infos
            self._seen, more, ended, timed_out, infos = self._once()
            rewards = {agent: rewards[agent] + more[agent] for agent in rewards}
            for agent, info in infos.items():
                # What rewards are made of adds up as they do.
                terms = [key for key in info if key.startswith("reward/")]
                info.update({key: info[key] + before[agent][key] for key in terms})
        return self._encoded(), rewards, ended, timed_out, infos

    def _once(self) -> ParallelStep:
        step: ParallelStep = self.env.step(
            {agent: scheme.action(self._seen[agent]) for agent, scheme in self._schemes.items()}
        )
        return step

    def _asks(self) -> bool:
        return any(scheme.asks(self._seen[agent]) for agent, scheme in self._schemes.items())

    def _encoded(self) -> dict[str, Vector]:
        return {agent: self._features[agent](self._seen[agent]) for agent in self._features}

    def _checked(self, agent: str, actions: Any) -> Vector:
        size = self._schemes[agent].size
        values = actions.get(agent) if isinstance(actions, Mapping) else None
        try:
            outputs = np.asarray(values, dtype=np.float32)
        except (TypeError, ValueError, RuntimeError):
            outputs = np.zeros(0, dtype=np.float32)
        if outputs.shape != (size,) or not np.isfinite(outputs).all():
            raise ActionError(f"the {agent}'s outputs must be {size} finite numbers, not {values!r}")
        return outputs


@overload
def encode(
    env: HandoverEnv | ParallelWrapper,
    features: str | Mapping[str, str] | None = None,
    schemes: str | Mapping[str, str] | None = None,
    *,
    api: Literal["parallel"] = "parallel",
) -> EncodedEnv: ...


@overload
def encode(
    env: HandoverEnv | ParallelWrapper,
    features: str | Mapping[str, str] | None = None,
    schemes: str | Mapping[str, str] | None = None,
    *,
    api: Literal["gymnasium"],
) -> SingleAgentEnv: ...


def encode(
    env: HandoverEnv | ParallelWrapper,
    features: str | Mapping[str, str] | None = None,
    schemes: str | Mapping[str, str] | None = None,
    *,
    api: Literal["parallel", "gymnasium"] = "parallel",
) -> EncodedEnv | SingleAgentEnv:
    """Show vectors of features instead of observations, and take outputs within -1 and 1 instead of actions.

    Args:
        env: `handover_marl.parallel_env(...)` or `freeze(...)` of it.
        features: Name of the features, or one for each agent; default: "giver" and "receiver". A name alone is for
            an environment of one agent.
        schemes: Name of the action scheme, likewise; default: "deviation" and "cartesian_delta".
        api: "parallel" makes a PettingZoo environment, "gymnasium", for one agent, a Gymnasium one.

    Raises:
        UnknownNameError: No such features, scheme or api.
        OptionError: An agent is named that is not there, or one name is given for two agents.
    """
    return as_api(EncodedEnv(env, _by_agent(env, features), _by_agent(env, schemes)), api)


def encoded_spaces(agent: str, features_name: str, scheme_name: str) -> tuple[spaces.Box, spaces.Box]:
    """Spaces of an agent's features and outputs."""
    seen = spaces.Box(-np.inf, np.inf, (n_features(agent, features_name),), np.float32)
    return seen, spaces.Box(-1.0, 1.0, (scheme_size(agent, scheme_name),), np.float32)


def _by_agent(env: Any, named: str | Mapping[str, str] | None) -> Mapping[str, str] | None:
    if not isinstance(named, str):
        return named
    if len(env.possible_agents) != 1:
        raise OptionError(f"there are {len(env.possible_agents)} agents; name features and schemes for each, as a dict")
    return {env.possible_agents[0]: named}


def _names(what: str, usual: dict[str, str], named: Mapping[str, str] | None, agents: list[str]) -> dict[str, str]:
    foreign = sorted((named or {}).keys() - set(agents))
    if foreign:
        raise OptionError(f"{what} are named for {foreign[0]!r}, but the agents here are {' and '.join(agents)}")
    return {agent: (named or {}).get(agent, usual[agent]) for agent in agents}
