"""Batch of handover environments: seeds, and resets after an episode's end."""

import contextlib
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from handover_marl.envs.vector.results import (
    EnvResult,
    copy_containers,
    make_final_infos,
    mask_infos,
    merge_results,
    replace_rows,
    select_rows,
)
from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SimulationError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, Indices, disable_gradients, is_tensor

Flags = npt.NDArray[np.bool_]

_BUSY = "another thread is using the vector environment; call reset() and step() in turn"


class Envs(Protocol):
    """Interface of environments that are simulated together; `rows` are indices of environments, a NumPy array.

    Attributes:
        arrays: Creator of the arrays that `reset` and `step` return.
    """

    arrays: ArrayFactory

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each."""

    def check_actions(self, actions: ByAgent) -> ByAgent:
        """Check the actions (n, ...) of all environments, and return them as `step` takes them."""

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with checked actions (r, ...) by agent."""

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""

    def close(self) -> None:
        """Free the simulation."""


class EnvBatch:
    """Batch of n environments, with the resets after an episode's end.

    Args:
        envs: The environments.
        num_envs: Number n of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.

    Attributes:
        num_envs: Number n of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.
        arrays: Creator of the arrays that `reset` and `step` return.
        is_running: Whether every environment has been reset, and no reset or step has failed since.
    """

    def __init__(self, envs: Envs, num_envs: int, autoreset: AutoresetMode) -> None:
        self.num_envs, self.autoreset, self.is_running = num_envs, autoreset, False
        self._is_closed, self._process, self._lock = False, os.getpid(), threading.Lock()
        self._envs, self.arrays = envs, envs.arrays
        self._ended = np.zeros(num_envs, dtype=bool)
        self._latest: EnvResult | None = None

    def __reduce__(self) -> NoReturn:
        raise OptionError("a vector environment cannot be copied or pickled; make another one, in its process")

    def reset(
        self,
        seed: int | Sequence[int | None] | None,
        options: dict[str, Any] | None,
        chosen: Flags | None = None,
    ) -> tuple[ByAgent, ByAgent]:
        """Start an episode in every environment, or in some.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a sequence with a
                seed for each environment; None keeps the state of all random generators.
            options: Options of `reset` that every environment gets.
            chosen: (n,) mask of the environments to reset; default: all.

        Returns:
            Observations of all environments by agent; those that were not reset keep their last ones. And their infos
            in Gymnasium's form, of the environments that were reset.

        Raises:
            OptionError: The number of seeds is not the number of environments, a seed is not an integer from
                0 on, or `options` is not a mapping.
            ResetNeededError: The environments are closed, or were made by another process.
            SimulationError: Another thread is using the environments.
        """
        self._require_usable()
        if options is not None and not isinstance(options, Mapping):
            raise OptionError(f"options must be a dict, got {options!r}")
        chosen = np.ones(self.num_envs, dtype=bool) if chosen is None else chosen
        rows = np.flatnonzero(chosen)
        seeds = self._spread_seeds(seed)
        with self._exclude_other_threads():
            is_running, self.is_running = self.is_running or len(rows) == self.num_envs, False
            row_results = [(rows, self._envs.reset(rows, [seeds[row] for row in rows.tolist()], options or None))]
            if self._latest is not None and len(rows) < self.num_envs:
                row_results.insert(0, (np.arange(self.num_envs), self._latest))
            result = merge_results(self.num_envs, row_results)
            infos = {agent: mask_infos(own, chosen, self.arrays) for agent, own in result.infos.items()}
            self.is_running, self._ended[rows] = is_running, False
        self._latest = copy_containers(result)
        return result.observations, infos

    def require_running(self) -> None:
        """Check that every environment can be stepped.

        Raises:
            ResetNeededError: There was no reset, a reset or step has failed since, or an episode has
                ended and autoreset is "disabled".
            SimulationError: Another thread is using the environments.
        """
        self._require_usable()
        is_disabled = self.autoreset is AutoresetMode.DISABLED
        if not self.is_running or (is_disabled and self._ended.any()):
            raise ResetNeededError("no episode is running; call reset() before step()")

    def step(self, actions: ByAgent) -> EnvResult:
        """Step every environment, and reset those whose episode has ended as `autoreset` specifies.

        Args:
            actions: Actions (n, ...) by agent.

        Returns:
            Result of all environments; those that were reset have the observations of the reset. The infos have
            Gymnasium's form, with the last observations and infos of episodes that ended and were reset.

        Raises:
            ActionError: An action is malformed; no environment has advanced.
        """
        checked = self._envs.check_actions(actions)
        with self._exclude_other_threads():
            self.is_running = False
            waiting, running = np.flatnonzero(self._ended), np.flatnonzero(~self._ended)
            row_results = []
            if len(waiting):
                row_results.append((waiting, self._envs.reset(waiting, [None] * len(waiting), None)))
            if len(running):
                row_results.append((running, self._envs.step(running, select_rows(checked, running))))
            result, final = merge_results(self.num_envs, row_results), None
            self._ended = result.ended
            if self.autoreset is AutoresetMode.SAME_STEP and self._ended.any():
                final, rows = result, np.flatnonzero(self._ended)
                first = self._envs.reset(rows, [None] * len(rows), None)
                result = result._replace(
                    observations=replace_rows(result.observations, rows, first.observations),
                    infos=replace_rows(result.infos, rows, first.infos),
                )
            every, infos = np.ones(self.num_envs, dtype=bool), {}
            for agent, own in result.infos.items():
                infos[agent] = mask_infos(own, every, self.arrays)
                if final is not None:
                    last = final.observations[agent], final.infos[agent]
                    infos[agent] |= make_final_infos(*last, self._ended, self.arrays)
            if final is not None:
                self._ended = np.zeros(self.num_envs, dtype=bool)
            self.is_running = True
        self._latest = copy_containers(result)
        return result._replace(infos=infos)

    def render(self) -> tuple[Any, ...] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        images = self._envs.render()
        return None if images is None else tuple(images)

    def close(self) -> None:
        """Free the simulations of all environments."""
        self.is_running, self._is_closed = False, True
        self._envs.close()

    def _require_usable(self) -> None:
        if self._is_closed:
            raise ResetNeededError("the vector environment is closed; make another one")
        if os.getpid() != self._process:
            # Threads do not survive a fork, so the simulation would wait for them forever.
            raise ResetNeededError("the vector environment was made by another process; make it after the fork")
        if self._lock.locked():
            raise SimulationError(_BUSY)

    @contextlib.contextmanager
    def _exclude_other_threads(self) -> Iterator[None]:
        if not self._lock.acquire(blocking=False):
            raise SimulationError(_BUSY)
        try:
            with contextlib.nullcontext() if self.arrays == NUMPY_ARRAYS else disable_gradients():
                yield
        finally:
            self._lock.release()

    def _spread_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Derive one seed for each environment from a seed or a sequence of seeds."""
        count = self.num_envs
        if seed is None:
            return [None] * count
        if isinstance(seed, (int, np.integer)) and seed >= 0:
            return list(range(int(seed), int(seed) + count))
        seeds = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else [seed]
        is_valid = all(value is None or (isinstance(value, (int, np.integer)) and value >= 0) for value in seeds)
        if len(seeds) != count or not is_valid:
            raise OptionError(f"seed must be an integer from 0 on or {count} such seeds, got {seed!r}")
        return [None if value is None else int(value) for value in seeds]


def check_action_array(
    actions: Any, space: spaces.Space[Any], count: int, agent: str, arrays: ArrayFactory = NUMPY_ARRAYS
) -> AnyArray:
    """Check the shape and type of the actions of all environments, and return them as an array.

    Args:
        actions: Actions (count, ...) of an agent.
        space: Action space of the agent in one environment.
        count: Number of environments.
        agent: Name of the agent, for errors.
        arrays: Creator of the environments' arrays; if it creates tensors, tensors are returned unchanged.

    Raises:
        ActionError: The actions are not a numeric array of this shape.
    """
    shape = (count, *(space.shape or ()))
    if is_tensor(actions) and arrays is not NUMPY_ARRAYS:
        is_number = arrays.xp.isdtype(actions.dtype, ("integral", "real floating"))
        if tuple(actions.shape) != shape or not is_number or actions.requires_grad:
            gradient = " with a gradient; pass tensor.detach()" if actions.requires_grad else ""
            raise ActionError(
                f"actions of the {agent} must have shape {shape}, got {actions.dtype} {tuple(actions.shape)}{gradient}"
            )
        return actions
    try:
        values = np.asarray(actions)
    except (ValueError, TypeError, RuntimeError) as error:  # ragged lists, tensors with a gradient or on a GPU
        raise ActionError(f"actions of the {agent} must be an array of shape {shape} ({error})") from error
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise ActionError(f"actions of the {agent} must have shape {shape}, got {values.dtype} {values.shape}")
    return values
