"""Equal spaces for all agents, for libraries that train one network for all of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle

from handover_marl.envs.flatten import flatten
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrapper import ParallelStep, ParallelWrapper
from handover_marl.errors import ActionError, ResetNeededError

Array = npt.NDArray[Any]


class HomogeneousEnv(ParallelWrapper):
    """Agents that see and do vectors of one size. Made by `homogeneous`.

    An observation is the agent's own vector, zeros up to the longest one, and one number an agent, 1 where it is this
    one's. Of an action, an agent's own numbers come first; what follows is ignored. Bounds are as wide as the widest
    agent's, number by number; an action is clipped to the agent's own.

    Args:
        env: What is made homogeneous; dictionaries are flattened first.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_homogeneous_v0"}

    def __init__(self, env: HandoverEnv | ParallelWrapper) -> None:
        EzPickle.__init__(self, env)
        dictionaries = any(isinstance(env.observation_space(agent), spaces.Dict) for agent in env.possible_agents)
        super().__init__(flatten(env) if dictionaries else env)
        self._own: dict[str, Any] = {agent: self.env.observation_space(agent) for agent in env.possible_agents}
        agents = self.possible_agents
        seen = _common([self._own[agent] for agent in agents])
        hot_low, hot_high = np.zeros(len(agents)), np.ones(len(agents))
        self._seen = spaces.Box(
            np.append(seen.low, hot_low).astype(seen.dtype), np.append(seen.high, hot_high).astype(seen.dtype)
        )
        self._done = _common([self.env.action_space(agent) for agent in agents])
        period = getattr(self.env.action_space(agents[0]), "control_period", None)
        if period is not None:
            self._done.control_period = period  # type: ignore[attr-defined]

    def observation_space(self, agent: str) -> spaces.Box:
        """All agents' observations."""
        return self._seen

    def action_space(self, agent: str) -> spaces.Box:
        """All agents' actions."""
        return self._done

    def sizes(self, agent: str) -> tuple[int, int]:
        """How many numbers of observations and of actions are the agent's own; they come first."""
        return _size(self._own[agent]), _size(self.env.action_space(agent))

    def own_observation(self, agent: str, vector: Array) -> Array:
        """An agent's own observation from one of those that all have."""
        return vector[: self.sizes(agent)[0]]

    def own_action(self, agent: str, action: Any) -> Array:
        """An agent's own action from one of those that all have, within its bounds.

        Raises:
            ActionError: It is none of those.
        """
        try:
            values = np.asarray(action, dtype=np.float32)
        except (TypeError, ValueError, RuntimeError):
            values = np.zeros(0, dtype=np.float32)
        # What is beyond the agent's own may be anything.
        n = self.sizes(agent)[1]
        if values.shape != self._done.shape or not np.isfinite(values[:n]).all():
            raise ActionError(f"the {agent}'s action must be {_size(self._done)} finite numbers, not {action!r}")
        space = self.env.action_space(agent)
        return np.clip(values[:n], space.low, space.high)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, float]]]:
        """As `HandoverEnv.reset`."""
        observations, infos = self.env.reset(seed, options)
        return self._padded(observations), infos

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """As `HandoverEnv.step`.

        Raises:
            ActionError: An action is missing or malformed, or there is no such agent; the world has not moved.
            ResetNeededError: No episode is running.
        """
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        if not isinstance(actions, Mapping) or actions.keys() - set(self.agents):
            raise ActionError(f"step() takes a dict with actions for {' and '.join(self.agents)}")
        own = {agent: self.own_action(agent, actions.get(agent)) for agent in self.agents}
        observations, *rest = self.env.step(own)
        return self._padded(observations), *rest

    def _padded(self, observations: dict[str, Any]) -> dict[str, Array]:
        padded = {}
        for agent, own in observations.items():
            padded[agent] = np.zeros(self._seen.shape, dtype=self._seen.dtype)
            padded[agent][: len(own)] = own
            padded[agent][self.possible_agents.index(agent) - len(self.possible_agents)] = 1.0
        return padded


def homogeneous(env: HandoverEnv | ParallelWrapper) -> HomogeneousEnv:
    """Give all agents one observation space and one action space, by padding, and tell them who they are.

    Args:
        env: `handover_marl.parallel_env(...)`, or `flatten`, `freeze` or `encode` of it; dictionaries are flattened.
    """
    return HomogeneousEnv(env)


def _size(space: spaces.Box) -> int:
    return int(space.shape[0])


def _common(boxes: list[spaces.Box]) -> spaces.Box:
    """The smallest box that holds vectors of all boxes, shorter ones filled up with zeros."""
    size, dtype = max(map(_size, boxes)), np.result_type(*(box.dtype for box in boxes))
    lows, highs = (
        [np.pad(bound.astype(dtype), (0, size - len(bound))) for bound in bounds]
        for bounds in ([box.low for box in boxes], [box.high for box in boxes])
    )
    return spaces.Box(np.min(lows, axis=0), np.max(highs, axis=0), dtype=dtype.type)
