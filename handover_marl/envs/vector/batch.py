"""Batch of handover environments: seeds, resets after an episode's end, and threads."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from handover_marl.envs.vector.results import (
    EnvResult,
    copy_containers,
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
    """Interface of the environments that one thread simulates; `rows` are indices of environments, a NumPy array.

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


class BatchStep(NamedTuple):
    """Result of a step of all n environments.

    Attributes:
        result: Result of the step; for environments that were reset, it has the observations and infos
            of the reset.
        reset_rows: Numbers (e,) of the environments whose episodes ended and that were reset in this step, a NumPy
            array; empty unless the mode of the resets is "same_step".
        final: Result (e, ...) of the step that ended these episodes; None if there are none.
    """

    result: EnvResult
    reset_rows: Indices
    final: EnvResult | None

    def make_infos(self, agent: str, arrays: ArrayFactory) -> dict[str, Any]:
        """Return an agent's infos in Gymnasium's form, with the last observations and infos of ended episodes."""
        count = len(self.result.rewards[agent])
        infos = mask_infos(self.result.infos[agent], np.ones(count, dtype=bool), arrays)
        if self.final is None:
            return infos
        final_obs = np.full(count, None, dtype=object)
        for place, number in enumerate(self.reset_rows.tolist()):
            final_obs[number] = select_rows(self.final.observations[agent], place)
        mask = np.isin(np.arange(count), self.reset_rows)
        last, rows = {}, arrays.asarray(self.reset_rows)
        for key, values in self.final.infos[agent].items():
            last[key] = arrays.xp.zeros((count, *values.shape[1:]), dtype=values.dtype, device=arrays.device)
            last[key][rows] = values
        infos |= {"final_obs": final_obs, "_final_obs": mask}
        return infos | {"final_info": mask_infos(last, mask, arrays), "_final_info": arrays.asarray(mask.copy())}


class _ThreadEnvs:
    """Environments of one thread, with the resets after an episode's end.

    Args:
        envs: The environments.
        rows: Their numbers in the batch.
        autoreset: Mode of the resets.
    """

    def __init__(self, envs: Envs, rows: Indices, autoreset: AutoresetMode) -> None:
        self.envs, self.rows, self._autoreset = envs, rows, autoreset
        self._ended = np.zeros(len(rows), dtype=bool)

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in some of the environments."""
        result = self.envs.reset(rows, seeds, options)
        self._ended[rows] = False
        return result

    def has_ended(self) -> bool:
        """Return whether any episode has ended."""
        return bool(self._ended.any())

    def step(self, actions: ByAgent) -> BatchStep:
        """Step the environments, and reset those whose episode has ended as the mode specifies."""
        count = len(self.rows)
        waiting = np.flatnonzero(self._ended)
        row_results = []
        if len(waiting):
            row_results.append((waiting, self.reset(waiting, [None] * len(waiting), None)))
        running = np.setdiff1d(np.arange(count), waiting)
        if len(running):
            row_results.append((running, self.envs.step(running, select_rows(actions, running))))
        result = merge_results(count, row_results)
        ended = np.flatnonzero(result.ended)
        if self._autoreset is not AutoresetMode.SAME_STEP or not len(ended):
            self._ended = result.ended
            return BatchStep(result, ended[:0], None)
        first = self.reset(ended, [None] * len(ended), None)
        observations = replace_rows(result.observations, ended, first.observations)
        infos = replace_rows(result.infos, ended, first.infos)
        return BatchStep(
            result._replace(observations=observations, infos=infos), self.rows[ended], select_rows(result, ended)
        )


class EnvBatch:
    """Batch of n environments, divided among threads.

    Args:
        make: Function that makes a number of environments.
        num_envs: Number n of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.
        threads: Number of threads.

    Attributes:
        num_envs: Number n of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.
        arrays: Creator of the arrays that `reset` and `step` return.
        is_running: Whether every environment has been reset, and no reset or step has failed since.
    """

    def __init__(self, make: Callable[[int], Envs], num_envs: int, autoreset: AutoresetMode, threads: int) -> None:
        self.num_envs, self.autoreset, self.is_running = num_envs, autoreset, False
        self._is_closed, self._process, self._lock = False, os.getpid(), threading.Lock()
        rows_by_thread = np.array_split(np.arange(num_envs), min(threads, num_envs))
        self._thread_envs = [_ThreadEnvs(make(len(rows)), rows, autoreset) for rows in rows_by_thread]
        self.arrays = self._thread_envs[0].envs.arrays
        self._pool = ThreadPoolExecutor(len(rows_by_thread)) if len(rows_by_thread) > 1 else None
        self._latest: EnvResult | None = None

    def __reduce__(self) -> NoReturn:
        raise OptionError("a vector environment cannot be copied or pickled; make another one, in its process")

    def reset(
        self,
        seed: int | Sequence[int | None] | None,
        options: dict[str, Any] | None,
        chosen: Flags | None = None,
    ) -> EnvResult:
        """Start an episode in every environment, or in some.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a sequence with a
                seed for each environment; None keeps the state of all random generators.
            options: Options of `reset` that every environment gets.
            chosen: (n,) mask of the environments to reset; default: all.

        Returns:
            Result of all environments; environments that were not reset keep their last result.

        Raises:
            OptionError: The number of seeds is not the number of environments, a seed is not an integer from
                0 on, or `options` is not a mapping.
            ResetNeededError: The environments are closed, or were made by another process.
            SimulationError: Another thread is using the environments.
        """
        self._require_usable()
        if options is not None and not isinstance(options, Mapping):
            raise OptionError(f"options must be a dict, got {options!r}")
        rows = np.arange(self.num_envs) if chosen is None else np.flatnonzero(chosen)
        seeds = self._spread_seeds(seed)
        # If a task fails, the states of the others are undefined: all must be reset.
        with self._exclude_other_threads():
            is_running, self.is_running = self.is_running or len(rows) == self.num_envs, False

            def reset(envs: _ThreadEnvs) -> tuple[Indices, EnvResult] | None:
                reset_rows = envs.rows[np.isin(envs.rows, rows)]
                if not len(reset_rows):
                    return None
                own_seeds = [seeds[row] for row in reset_rows.tolist()]
                return reset_rows, envs.reset(reset_rows - envs.rows[0], own_seeds, options or None)

            row_results = [row_result for row_result in self._map(reset) if row_result is not None]
            if self._latest is not None and len(rows) < self.num_envs:
                row_results.insert(0, (np.arange(self.num_envs), self._latest))
            self.is_running, result = is_running, merge_results(self.num_envs, row_results)
        self._latest = copy_containers(result)
        return result

    def require_running(self) -> None:
        """Check that every environment can be stepped.

        Raises:
            ResetNeededError: There was no reset, a reset or step has failed since, or an episode has
                ended and autoreset is "disabled".
            SimulationError: Another thread is using the environments.
        """
        self._require_usable()
        is_disabled = self.autoreset is AutoresetMode.DISABLED
        if not self.is_running or (is_disabled and any(envs.has_ended() for envs in self._thread_envs)):
            raise ResetNeededError("no episode is running; call reset() before step()")

    def step(self, actions: ByAgent) -> BatchStep:
        """Step every environment, and reset those whose episode has ended as `autoreset` specifies.

        Args:
            actions: Actions (n, ...) by agent.

        Raises:
            ActionError: An action is malformed; no environment has advanced.
        """
        checked = self._thread_envs[0].envs.check_actions(actions)
        with self._exclude_other_threads():
            self.is_running = False
            steps: list[BatchStep] = self._map(lambda envs: envs.step(select_rows(checked, envs.rows)))
            self.is_running = True
        row_results = [(envs.rows, step.result) for envs, step in zip(self._thread_envs, steps, strict=True)]
        result = merge_results(self.num_envs, row_results)
        self._latest = copy_containers(result)
        reset_rows, final = np.concatenate([step.reset_rows for step in steps]), None
        if len(reset_rows):
            places = np.split(np.arange(len(reset_rows)), np.cumsum([len(step.reset_rows) for step in steps])[:-1])
            finals = [(rows, step.final) for rows, step in zip(places, steps, strict=True) if step.final is not None]
            final = merge_results(len(reset_rows), finals)
        return BatchStep(result, reset_rows, final)

    def render(self) -> tuple[Any, ...] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        images = [image for envs in self._thread_envs for image in envs.envs.render() or ()]
        return tuple(images) if images else None

    def close(self) -> None:
        """Free the simulations of all environments."""
        self.is_running, self._is_closed = False, True
        for envs in self._thread_envs:
            envs.envs.close()
        if self._pool is not None:
            self._pool.shutdown()

    def _map(self, function: Callable[[_ThreadEnvs], Any]) -> list[Any]:
        if self._pool is None:
            return [function(envs) for envs in self._thread_envs]
        futures = [self._pool.submit(function, envs) for envs in self._thread_envs]
        # All threads finish before the first error is raised.
        errors = [error for future in futures if (error := future.exception()) is not None]
        if errors:
            raise errors[0]
        return [future.result() for future in futures]

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
