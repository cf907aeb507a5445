"""One vector for each agent's observation, for libraries that take no dictionaries."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle

from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrapper import ParallelStep, ParallelWrapper
from handover_marl.errors import OptionError

Array = npt.NDArray[Any]


class FlattenedEnv(ParallelWrapper):
    """Dictionaries of arrays become vectors, in the order of Gymnasium's `flatten`; actions stay. Made by `flatten`.

    Args:
        env: What is flattened; agents that see vectors already keep them.

    Raises:
        OptionError: An agent sees what makes no vector.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_flattened_v0"}

    def __init__(self, env: HandoverEnv | ParallelWrapper) -> None:
        EzPickle.__init__(self, env)
        super().__init__(env)
        self._flat: dict[str, spaces.Box] = {agent: _flat_space(env, agent) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Box:
        """The agent's vectors."""
        return self._flat[agent]

    def unflatten(self, agent: str, vector: Array) -> Any:
        """The observation that a vector stands for.

        Raises:
            OptionError: It is no vector of the agent's.
        """
        if np.shape(vector) != self._flat[agent].shape:
            raise OptionError(
                f"the {agent}'s observations are vectors of shape {self._flat[agent].shape}, not {np.shape(vector)}"
            )
        return spaces.unflatten(self.env.observation_space(agent), vector)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, float]]]:
        """As `HandoverEnv.reset`."""
        observations, infos = self.env.reset(seed, options)
        return self._flattened(observations), infos

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """As `HandoverEnv.step`."""
        observations, *rest = self.env.step(actions)
        return self._flattened(observations), *rest

    def _flattened(self, observations: dict[str, Any]) -> dict[str, Array]:
        seen = {}
        for agent, observation in observations.items():
            vector: Any = spaces.flatten(self.env.observation_space(agent), observation)
            seen[agent] = np.asarray(vector, dtype=self._flat[agent].dtype)
        return seen


def flatten(env: HandoverEnv | ParallelWrapper) -> FlattenedEnv:
    """Show every agent one vector instead of a dictionary of arrays: everything there is to see, units as they are.

    `encode` makes vectors, too: few features, chosen and scaled for small networks.

    Args:
        env: `handover_marl.parallel_env(...)`, or `freeze(...)` of it.
    """
    return FlattenedEnv(env)


def _flat_space(env: HandoverEnv | ParallelWrapper, agent: str) -> spaces.Box:
    flat = spaces.flatten_space(env.observation_space(agent))
    if not isinstance(flat, spaces.Box):
        raise OptionError(f"what the {agent} sees makes no vector")
    return flat
