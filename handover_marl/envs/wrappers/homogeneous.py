"""Wrapper with equal spaces for all agents, for libraries that train one network for all of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle

from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.wrapper import ParallelStep, ParallelWrapper, WrappableEnv, check_env, flatten
from handover_marl.episode.spaces import check_vector
from handover_marl.errors import ActionError, ResetNeededError

Array = npt.NDArray[Any]


class HomogeneousEnv(ParallelWrapper):
    """Wrapper whose agents share one observation space and one action space.

    An observation is the agent's vector, padded with zeros to the length of the longest vector, and a
    one-hot code of the agent. An action starts with the agent's components; further components are
    ignored. The bounds of the shared spaces include the bounds of all agents; an action is clipped to
    the agent's bounds. Made by `homogeneous`.

    Args:
        env: Environment to make homogeneous; dictionaries are flattened first.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_homogeneous_v0"}

    def __init__(self, env: WrappableEnv) -> None:
        check_env(env)
        has_dictionaries = any(isinstance(env.observation_space(agent), spaces.Dict) for agent in env.possible_agents)
        super().__init__(flatten(env) if has_dictionaries else env)
        EzPickle.__init__(self, env)
        agents = self.possible_agents
        self._own: dict[str, Any] = {agent: self.env.observation_space(agent) for agent in agents}
        padded = _merge_boxes([self._own[agent] for agent in agents])
        self._observations = spaces.Box(
            np.append(padded.low, np.zeros(len(agents))).astype(padded.dtype),
            np.append(padded.high, np.ones(len(agents))).astype(padded.dtype),
        )
        self._actions = _merge_boxes([self.env.action_space(agent) for agent in agents])
        period = getattr(self.env.action_space(agents[0]), "control_period", None)
        if period is not None:
            self._actions.control_period = period  # type: ignore[attr-defined]

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space that all agents share."""
        return self._observations

    def action_space(self, agent: str) -> spaces.Box:
        """Return the action space that all agents share."""
        return self._actions

    def get_sizes(self, agent: str) -> tuple[int, int]:
        """Return the lengths of an agent's observation and of its action, both without padding."""
        return _size(self._own[agent]), _size(self.env.action_space(agent))

    def unpad_action(self, agent: str, action: Any) -> Array:
        """Return an agent's action without padding, clipped to the bounds of the agent's actions.

        Args:
            agent: Name of the agent.
            action: Padded action of the agent.

        Raises:
            ActionError: The action has another shape, or a component of the agent is not finite.
        """
        space, n = self.env.action_space(agent), self.get_sizes(agent)[1]
        values = check_vector(
            f"action of the {agent}", action, _size(self._actions), f"of which {n} are used", n_finite=n
        )
        return np.clip(values[:n], space.low, space.high)

    def convert_observation(self, agent: str, observation: Array) -> Array:
        """Pad an agent's observation with zeros and append the one-hot code of the agent."""
        padded = np.zeros(self._observations.shape, dtype=self._observations.dtype)
        padded[: len(observation)] = observation
        padded[self.possible_agents.index(agent) - len(self.possible_agents)] = 1.0
        return padded

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """Let the agents act for one control period; result as in `HandoverEnv.step`.

        Args:
            actions: Padded actions by agent, elements of the shared action space.

        Raises:
            ActionError: An action is missing or malformed; the simulation has not advanced.
            ResetNeededError: No episode is running.
        """
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        if not isinstance(actions, Mapping) or actions.keys() - set(self.agents):
            raise ActionError(f"actions must be a dict for {' and '.join(self.agents)}")
        return super().step({agent: self.unpad_action(agent, actions.get(agent)) for agent in self.agents})


def homogeneous(env: WrappableEnv) -> HomogeneousEnv:
    """Return an environment that pads the spaces of all agents to one common size.

    Args:
        env: `handover_marl.parallel_env(...)`, or `flatten`, `freeze` or `encode` of it; dictionaries
            are flattened.
    """
    return HomogeneousEnv(env)


def _size(space: spaces.Box) -> int:
    return int(space.shape[0])


def _merge_boxes(boxes: list[spaces.Box]) -> spaces.Box:
    """Return the smallest box that contains all boxes, each padded with zeros to the longest."""
    size, dtype = max(map(_size, boxes)), np.result_type(*(box.dtype for box in boxes))
    lows, highs = (
        [np.pad(bound.astype(dtype), (0, size - len(bound))) for bound in bounds]
        for bounds in ([box.low for box in boxes], [box.high for box in boxes])
    )
    return spaces.Box(np.min(lows, axis=0), np.max(highs, axis=0), dtype=dtype.type)
