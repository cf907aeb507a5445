"""Wrapper with one vector for each agent's observation, for libraries that take no dictionaries."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle

from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.wrapper import ParallelWrapper, WrappableEnv
from handover_marl.errors import OptionError

Array = npt.NDArray[Any]


class FlattenedEnv(ParallelWrapper):
    """Wrapper whose observations are vectors in the order of Gymnasium's `flatten`.

    Actions are unchanged. Made by `flatten`.

    Args:
        env: Environment to flatten; observations that are vectors already are unchanged.

    Raises:
        OptionError: An agent's observation space cannot be flattened to a vector.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_flattened_v0"}

    def __init__(self, env: WrappableEnv) -> None:
        super().__init__(env)
        EzPickle.__init__(self, env)
        self._flat: dict[str, spaces.Box] = {}
        for agent in self.possible_agents:
            flat = spaces.flatten_space(env.observation_space(agent))
            if not isinstance(flat, spaces.Box):
                raise OptionError(f"observation space of the {agent} cannot be flattened to a vector")
            self._flat[agent] = flat

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the space of the agent's flattened observations."""
        return self._flat[agent]

    def convert_observation(self, agent: str, observation: Any) -> Array:
        """Flatten an agent's observation to one vector."""
        vector: Any = spaces.flatten(self.env.observation_space(agent), observation)
        return np.asarray(vector, dtype=self._flat[agent].dtype)

    def unflatten(self, agent: str, vector: Array) -> Any:
        """Convert an agent's vector back to the observation of the wrapped environment.

        Raises:
            OptionError: The vector has another shape than the agent's.
        """
        if np.shape(vector) != self._flat[agent].shape:
            raise OptionError(
                f"vector of the {agent} must have shape {self._flat[agent].shape}, got {np.shape(vector)}"
            )
        return spaces.unflatten(self.env.observation_space(agent), vector)


def flatten(env: WrappableEnv) -> FlattenedEnv:
    """Return an environment with one vector for each agent's observation, unscaled.

    `encode` makes vectors, too: fewer features, scaled for small networks.

    Args:
        env: `handover_marl.parallel_env(...)`, or `freeze(...)` of it.
    """
    return FlattenedEnv(env)
