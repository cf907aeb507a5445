"""Vector environment of both agents: PettingZoo's parallel API with arrays in place of single values."""

from typing import Any

from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from handover_marl.envs.vector.batch import EnvBatch, EnvResult
from handover_marl.envs.wrappers.wrapper import ByAgent, WrappableEnv
from handover_marl.simulation.camera.optics import CameraInfo


class ParallelVectorEnv:
    """Vector environment of both agents, made by `handover_marl.vector_env(..., agent=None)`.

    The API is PettingZoo's parallel API; the dictionaries by agent hold arrays (n, ...) of n
    environments. The reset after an episode's end follows Gymnasium's modes:

    - "next_step": the next step ignores the actions, and returns the first observations of the next
      episode with rewards of 0.
    - "same_step": the last step of an episode returns the first observations of the next episode with
      the last rewards. `infos[agent]` then has the last observations and infos in "final_obs" and "final_info".
    - "disabled": the caller resets.

    `infos[agent]` has the form of the infos of `HandoverVectorEnv`, with arrays and tensors in the same places.

    Args:
        batch: The environments.
        template: Single environment with the same spaces.

    Attributes:
        num_envs: Number of environments.
        possible_agents: Names of the agents; both act in all environments at all times.
        autoreset_mode: Gymnasium's mode of the reset after an episode's end.
        scene_ids: Numbers of the scenes that the environments draw from.
        metadata: Metadata of a single environment, and `autoreset_mode`.
    """

    def __init__(self, batch: EnvBatch, template: WrappableEnv) -> None:
        self._batch, self._template = batch, template
        self.num_envs = batch.num_envs
        self.possible_agents: list[str] = list(template.possible_agents)
        self.autoreset_mode = batch.autoreset
        self.scene_ids: tuple[int, ...] = template.unwrapped.scene_ids
        self.metadata: dict[str, Any] = {**template.unwrapped.metadata, "autoreset_mode": batch.autoreset}

    @property
    def agents(self) -> list[str]:
        """Names of the acting agents; empty before the first reset."""
        return self.possible_agents if self._batch.is_running else []

    def single_observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's observation space in one environment."""
        return self._template.observation_space(agent)

    def single_action_space(self, agent: str) -> spaces.Box:
        """Return an agent's action space in one environment."""
        return self._template.action_space(agent)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's observation space, batched over all n environments."""
        return batch_space(self.single_observation_space(agent), self.num_envs)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's action space, batched over all n environments."""
        return batch_space(self.single_action_space(agent), self.num_envs)

    def reset(
        self, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ByAgent, ByAgent]:
        """Start an episode in every environment, or in some with `options={"reset_mask": (n,) bool}`.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a list with a seed
                for each environment.
            options: Options that every environment gets: `{"scene_id": n}` chooses the scene; and `reset_mask`.

        Returns:
            Observations and infos by agent.

        Raises:
            OptionError: The number of seeds or the shape of the mask is wrong, or no environment is chosen.
        """
        return self._batch.reset(seed, options)

    def step(self, actions: ByAgent) -> EnvResult:
        """Step every environment with the actions of both agents.

        Args:
            actions: Actions (n, ...) by agent, arrays or tensors; see `HandoverVectorEnv.step`.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ActionError: An agent's actions are missing or malformed.
            ResetNeededError: There was no reset, or an episode has ended and autoreset is "disabled".
        """
        return self._batch.step(actions)

    def camera_info(self) -> dict[str, CameraInfo]:
        """Return size, intrinsics and pose of each camera by name, the same in all environments and episodes."""
        found: dict[str, CameraInfo] = self._template.unwrapped.camera_info()
        return found

    def close(self) -> None:
        """Free the simulations of all environments."""
        self._batch.close()
