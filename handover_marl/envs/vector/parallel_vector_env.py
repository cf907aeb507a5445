"""Vector environment of both agents: PettingZoo's parallel API with arrays in place of single values."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from handover_marl.envs.vector.batch import EnvBatch, ResetResult, split_actions
from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.errors import ActionError

BatchStep = tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]


class ParallelVectorEnv:
    """Vector environment of both agents, made by `handover_marl.vector_env(..., agent=None)`.

    The API is PettingZoo's parallel API; the dictionaries by agent hold arrays (n, ...) of n
    environments. The reset after an episode's end follows Gymnasium's modes:

    - "next_step": the next step ignores the actions, and returns the first observations of the next
      episode with rewards of 0.
    - "same_step": the last step of an episode returns the first observations of the next episode with
      the last rewards. `infos[agent]` then has the last observations in "final_obs" (n,), the last
      infos in "final_info" (n,), and the mask of these environments in "_final_obs" (n,).
    - "disabled": the caller resets.

    Args:
        batch: Environments that are simulated in lockstep.

    Attributes:
        num_envs: Number of environments.
        possible_agents: Names of the agents; both act in all environments at all times.
        metadata: Metadata of a single environment, and `autoreset_mode`.
    """

    def __init__(self, batch: EnvBatch) -> None:
        self._batch = batch
        self.num_envs = len(batch.envs)
        first = batch.envs[0]
        self.possible_agents: list[str] = list(first.possible_agents)
        self.metadata: dict[str, Any] = {**first.metadata, "autoreset_mode": batch.autoreset}

    @property
    def agents(self) -> list[str]:
        """Names of the acting agents; empty before the first reset."""
        return self.possible_agents if self._batch.is_running else []

    def single_observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's observation space in one environment."""
        return self._batch.envs[0].observation_space(agent)

    def single_action_space(self, agent: str) -> spaces.Box:
        """Return an agent's action space in one environment."""
        return self._batch.envs[0].action_space(agent)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's observation space, batched over all n environments."""
        return batch_space(self.single_observation_space(agent), self.num_envs)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's action space, batched over all n environments."""
        return batch_space(self.single_action_space(agent), self.num_envs)

    def reset(self, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode in every environment.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a list with a seed
                for each environment.
            options: Options that every environment gets: `{"scene_id": n}` chooses the scene.

        Raises:
            OptionError: The number of seeds is not the number of environments.
        """
        results = self._batch.reset(seed, options)
        return self._stack_observations([first for first, _ in results]), self._stack_infos([two for _, two in results])

    def step(self, actions: ByAgent) -> BatchStep:
        """Step every environment with the actions of both agents.

        Args:
            actions: Actions (n, ...) by agent.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ActionError: An agent's actions are missing or malformed.
            ResetNeededError: There was no reset, or an episode has ended and autoreset is "disabled".
        """
        self._batch.require_running()
        rows = self._split_actions(actions)
        outcomes = self._batch.step(
            [{agent: row[index] for agent, row in rows.items()} for index in range(self.num_envs)]
        )
        # The last part of a step's result and of a reset's are infos.
        latest: list[Any] = [(reset or result) for result, reset in outcomes]
        infos = self._stack_infos([one[-1] for one in latest])
        if self._batch.autoreset is AutoresetMode.SAME_STEP:
            self._add_final(infos, [None if reset is None else result for result, reset in outcomes])
        rewards, terminations, truncations = (
            {
                agent: np.array([no_step if result is None else result[part][agent] for result, _ in outcomes])
                for agent in self.possible_agents
            }
            for part, no_step in ((1, 0.0), (2, False), (3, False))
        )
        return self._stack_observations([one[0] for one in latest]), rewards, terminations, truncations, infos

    def close(self) -> None:
        """Free the simulations of all environments."""
        self._batch.close()

    def _split_actions(self, actions: ByAgent) -> dict[str, list[npt.NDArray[Any]]]:
        if not isinstance(actions, dict) or actions.keys() != set(self.possible_agents):
            raise ActionError(f"actions must be a dict of arrays for {' and '.join(self.possible_agents)}")
        return {
            agent: split_actions(values, self.single_action_space(agent), self.num_envs, agent)
            for agent, values in actions.items()
        }

    def _add_final(self, infos: ByAgent, last: list[Any]) -> None:
        """Add the last observations and infos of the episodes that have ended in this step, if any.

        Args:
            infos: Infos by agent, which get the additions.
            last: Result of each environment's step if its episode has ended, else None.
        """
        ended = [index for index, result in enumerate(last) if result is not None]
        for agent in self.possible_agents if ended else ():
            final_obs, final_info = (np.full(self.num_envs, None, dtype=object) for _ in range(2))
            for index in ended:
                final_obs[index], final_info[index] = last[index][0][agent], last[index][4][agent]
            mask = np.isin(np.arange(self.num_envs), ended)
            infos[agent] |= {"final_obs": final_obs, "final_info": final_info, "_final_obs": mask}

    def _stack_observations(self, observations: list[ByAgent]) -> ByAgent:
        stacked = {}
        for agent in self.possible_agents:
            space = self.single_observation_space(agent)
            buffer: Any = create_empty_array(space, n=self.num_envs)
            stacked[agent] = concatenate(space, [one[agent] for one in observations], buffer)
        return stacked

    def _stack_infos(self, infos: list[ByAgent]) -> ByAgent:
        return {
            agent: {key: np.array([one[agent][key] for one in infos]) for key in infos[0][agent]}
            for agent in self.possible_agents
        }
