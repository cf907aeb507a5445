"""Vector environment in PettingZoo's parallel API, with arrays in place of single values."""

import contextlib
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from handover_marl.envs.vector.env_result import (
    EnvGroup,
    EnvResult,
    check_action_array,
    make_final_infos,
    mask_infos,
    merge_results,
    select_rows,
)
from handover_marl.envs.wrappers.wrapper import ByAgent, WrappableEnv
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SimulationError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, disable_gradients, to_numpy
from handover_marl.simulation.camera.optics import CameraInfo


class ParallelVectorEnv:
    """Vector environment of both agents, made by `handover_marl.vector_env(..., agent=None)`.

    The API is PettingZoo's parallel API; the dictionaries by agent hold arrays (n, ...) of n
    environments. The reset after an episode's end follows Gymnasium's modes:

    - "next_step": the step after an episode's end ignores the actions, and returns the first observations
      of the next episode and rewards of 0.
    - "same_step": the last step of an episode returns its last rewards and the first observations of the next
      episode. `infos[agent]` then has the last observations and infos in "final_obs" and "final_info".
    - "disabled": the caller resets.

    `infos[agent]` has the form of the infos of `HandoverVectorEnv`, with arrays and tensors in the same places.

    Args:
        envs: The environments.
        template: Single environment with the same spaces.
        num_envs: Number of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.

    Attributes:
        num_envs: Number of environments.
        possible_agents: Names of the agents; all act in all environments at all times.
        autoreset_mode: Gymnasium's mode of the reset after an episode's end.
        scene_ids: Numbers of the scenes that the environments draw from.
        metadata: Metadata of a single environment, and `autoreset_mode`.
    """

    def __init__(self, envs: EnvGroup, template: WrappableEnv, num_envs: int, autoreset: AutoresetMode) -> None:
        self._envs, self._arrays, self._template = envs, envs.arrays, template
        self.num_envs, self.autoreset_mode = num_envs, autoreset
        self.possible_agents: list[str] = list(template.possible_agents)
        self.scene_ids: tuple[int, ...] = template.unwrapped.scene_ids
        self.metadata: dict[str, Any] = {**template.metadata, "autoreset_mode": autoreset}
        self._is_closed, self._process, self._lock = False, os.getpid(), threading.Lock()
        # Whether every environment has been reset, and no reset or step has failed since.
        self._is_running = False
        self._ended = np.zeros(num_envs, dtype=bool)
        self._latest: EnvResult | None = None

    def __reduce__(self) -> NoReturn:
        raise OptionError("a vector environment cannot be copied or pickled; make another one, in its process")

    @property
    def agents(self) -> list[str]:
        """Names of the acting agents; empty before the first reset, after a failed reset or step, and after `close`."""
        return self.possible_agents if self._is_running else []

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
        self, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ByAgent, ByAgent]:
        """Start an episode in every environment, or in some with `options={"reset_mask": (n,) bool}`.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a sequence with a seed
                for each environment; None keeps the state of all random generators.
            options: "scene_id" is the scene of all environments; "reset_mask" is the mask (n,) of the environments to
                reset, an array or a tensor.

        Returns:
            Observations of all environments by agent, the latest ones of environments that were not reset; and infos,
            in Gymnasium's form, of the environments that were reset.

        Raises:
            OptionError: The number of seeds or the shape of the mask is wrong, a seed is negative or not an integer,
                `options` is not a mapping, or no environment is chosen.
            ResetNeededError: The first reset leaves out environments, or they are closed, or made by another process.
            SimulationError: Another thread is using the environments.
        """
        if options is not None and not isinstance(options, Mapping):
            raise OptionError(f"options must be a dict, got {options!r}")
        others = dict(options or {})
        mask = others.pop("reset_mask", None)
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else to_numpy(mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != bool or not chosen.any():
            raise OptionError(f"reset_mask must be {self.num_envs} truth values with at least one True, got {mask!r}")
        rows = np.flatnonzero(chosen)
        seeds = _spread_seeds(seed, self.num_envs)
        with self._use_envs():
            if self._latest is None and not chosen.all():
                raise ResetNeededError("the first reset must be of all environments; leave out reset_mask")
            is_running, self._is_running = self._is_running or bool(chosen.all()), False
            row_results = [(rows, self._envs.reset(rows, [seeds[row] for row in rows.tolist()], others or None))]
            if self._latest is not None and not chosen.all():
                row_results.insert(0, (np.arange(self.num_envs), self._latest))
            result = merge_results(self.num_envs, row_results)
            infos = {agent: mask_infos(own, chosen, self._arrays) for agent, own in result.infos.items()}
            self._is_running, self._ended[rows] = is_running, False
        # A copy, since callers change arrays and dictionaries.
        self._latest = select_rows(result, np.arange(self.num_envs))
        return result.observations, infos

    def step(self, actions: ByAgent) -> EnvResult:
        """Step every environment, and reset environments whose episode has ended as `autoreset_mode` specifies.

        Args:
            actions: Actions (n, ...) by agent, arrays or tensors; see `HandoverVectorEnv.step`.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent; environments that were reset have the
            observations of the reset.

        Raises:
            ActionError: An agent's actions are missing or malformed; no environment has advanced.
            ResetNeededError: There was no reset, a reset or step has failed since, an episode has ended and autoreset
                is "disabled", or the environments are closed.
            SimulationError: Another thread is using the environments.
        """
        count, arrays = self.num_envs, self._arrays
        with self._use_envs():
            if not self._is_running or (self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any()):
                raise ResetNeededError("no episode is running; call reset() before step()")
            if not isinstance(actions, dict) or actions.keys() != set(self.possible_agents):
                raise ActionError(f"actions must be a dict of arrays for {' and '.join(self.possible_agents)}")
            waiting, running = np.flatnonzero(self._ended), np.flatnonzero(~self._ended)
            checked = {
                agent: check_action_array(values, self.single_action_space(agent), count, agent, arrays, waiting)
                for agent, values in actions.items()
            }
            self._is_running = False
            row_results = []
            if len(waiting):
                row_results.append((waiting, self._envs.reset(waiting, [None] * len(waiting), None)))
            if len(running):
                row_results.append((running, self._envs.step(running, select_rows(checked, running))))
            result = merge_results(count, row_results)
            self._ended, final_infos = result.ended, {}
            if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
                for agent, own in result.infos.items():
                    final_infos[agent] = make_final_infos(result.observations[agent], own, self._ended, arrays)
                rows = np.flatnonzero(self._ended)
                first = self._envs.reset(rows, [None] * len(rows), None)
                both = merge_results(count, [(np.arange(count), result), (rows, first)])
                result = result._replace(observations=both.observations, infos=both.infos)
                self._ended = np.zeros(count, dtype=bool)
            every = np.ones(count, dtype=bool)
            infos = {
                agent: mask_infos(own, every, arrays) | final_infos.get(agent, {})
                for agent, own in result.infos.items()
            }
            self._is_running = True
        self._latest = select_rows(result, np.arange(count))
        return result._replace(infos=infos)

    def camera_info(self) -> dict[str, CameraInfo]:
        """Return size, intrinsics and pose of each camera by name, the same in all environments and episodes."""
        found: dict[str, CameraInfo] = self._template.unwrapped.camera_info()
        return found

    def render(self) -> tuple[Any, ...] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        with self._use_envs():
            images = self._envs.render()
        return None if images is None else tuple(images)

    def close(self) -> None:
        """Free the simulations of all environments, which cannot be used afterwards."""
        self._is_running, self._is_closed = False, True
        self._envs.close()

    @contextlib.contextmanager
    def _use_envs(self) -> Iterator[None]:
        """Check that the environments are usable; lock out other threads and disable gradients in a `with` block."""
        if self._is_closed:
            raise ResetNeededError("the vector environment is closed; make another one")
        if os.getpid() != self._process:
            # Threads do not survive a fork, so the simulation would wait for them forever.
            raise ResetNeededError("the vector environment was made by another process; make it after the fork")
        if not self._lock.acquire(blocking=False):
            raise SimulationError("another thread is using the vector environment; call reset() and step() in turn")
        try:
            with contextlib.nullcontext() if self._arrays == NUMPY_ARRAYS else disable_gradients():
                yield
        finally:
            self._lock.release()


def _spread_seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """Return the seeds of `count` environments: `seed` + k for number k, element k of a sequence, or None for None."""
    if isinstance(seed, (int, np.integer)):
        seeds: list[Any] = list(range(int(seed), int(seed) + count))
    else:
        seeds = [None] * count if seed is None else list(seed) if isinstance(seed, (Sequence, np.ndarray)) else []
    is_valid = all(value is None or (isinstance(value, (int, np.integer)) and value >= 0) for value in seeds)
    if len(seeds) != count or not is_valid:
        raise OptionError(f"seed must be an integer from 0 on or {count} such seeds, got {seed!r}")
    return [None if value is None else int(value) for value in seeds]
