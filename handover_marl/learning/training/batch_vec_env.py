"""Stable-Baselines3 VecEnv over a vector environment of this library."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.envs.wrappers.wrapper import REWARD_PREFIX
from handover_marl.errors import OptionError
from handover_marl.learning.training.run_folder import spawn_seeds


class BatchVecEnv(VecEnv):
    """Stable-Baselines3 VecEnv of the environments of a `HandoverVectorEnv`.

    Attributes and methods of single environments are not accessible.

    Args:
        envs: The environments, with `autoreset="same_step"` and the backend "threads".

    Raises:
        OptionError: `envs` is no `HandoverVectorEnv`, or has another autoreset mode.
    """

    def __init__(self, envs: HandoverVectorEnv) -> None:
        if not isinstance(envs, HandoverVectorEnv):
            raise OptionError(f"envs must be made by handover_marl.vector_env(), got {type(envs).__name__}")
        if envs.autoreset_mode is not AutoresetMode.SAME_STEP:
            mode = envs.autoreset_mode.name.lower()
            raise OptionError(f"envs must have autoreset='same_step', got {mode!r}; pass it to vector_env()")
        self._envs = envs
        self._actions: npt.NDArray[np.floating] = np.zeros(0)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set and return one seed per environment for the next reset, spawned from `seed`; None seeds nothing."""
        self._seeds = [None] * self.num_envs if seed is None else list(spawn_seeds(self.num_envs, seed))
        return self._seeds

    def reset(self) -> npt.NDArray[np.float32]:
        """Start an episode in each of the n environments; return the observations (n, ...)."""
        observations: npt.NDArray[np.float32] = self._envs.reset(seed=self._seeds)[0]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: npt.NDArray[np.floating]) -> None:
        """Store the actions (n, ...) of the n environments, which `step_wait` executes."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all n environments; return observations (n, ...), rewards (n,), whether episodes ended, (n,), and infos.

        Where an episode ended, the observation is the first one of the next episode, and the info is that of the last
        step, with its observation as `terminal_observation` and with `TimeLimit.truncated`. Other infos have the reward
        terms only.
        """
        observations, rewards, terminations, truncations, infos = self._envs.step(self._actions)
        ended = terminations | truncations
        terms = [key for key in infos if key.startswith(REWARD_PREFIX)]
        step_infos = [{key: infos[key][number] for key in terms} for number in range(self.num_envs)]
        for number in np.flatnonzero(ended).tolist():
            final = {key: value[number] for key, value in infos["final_info"].items() if not key.startswith("_")}
            step_infos[number] = {
                **final,
                "terminal_observation": infos["final_obs"][number],
                "TimeLimit.truncated": bool(truncations[number] and not terminations[number]),
            }
        return observations, rewards.astype(np.float32), ended, step_infos

    def close(self) -> None:
        """Free the simulations of all environments."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the attribute `render_mode` of each environment in `indices`; other names raise an AttributeError."""
        if attr_name != "render_mode":
            self.env_method(attr_name)
        return [self._envs.render_mode for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an AttributeError; attributes of environments in batches cannot be set."""
        self.env_method(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Raise an AttributeError; methods of environments in batches cannot be called."""
        raise AttributeError(f"single environments of a batch are not accessible, got {method_name!r}")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each environment in `indices`: none has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]
