"""Batch of handover environments: results of their steps, seeds, and resets after an episode's end."""

import contextlib
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SimulationError
from handover_marl.geometry.arrays import (
    NUMPY_ARRAYS,
    AnyArray,
    ArrayFactory,
    Indices,
    disable_gradients,
    get_namespace,
    is_tensor,
    to_numpy,
)

Flags = npt.NDArray[np.bool_]


class EnvResult(NamedTuple):
    """Result of a step or a reset of r environments: arrays (r, ...) by agent.

    Attributes:
        observations: Observations: arrays, or dictionaries of arrays.
        rewards: Rewards; zeros after a reset.
        terminated: Whether each episode has terminated.
        truncated: Whether each episode was truncated.
        infos: Infos: dictionaries of arrays.
    """

    observations: ByAgent
    rewards: ByAgent
    terminated: ByAgent
    truncated: ByAgent
    infos: ByAgent

    @property
    def ended(self) -> Flags:
        """Whether each episode has ended, a NumPy array (r,)."""
        flags = [*self.terminated.values(), *self.truncated.values()]
        xp = get_namespace(*flags)
        return to_numpy(xp.any(xp.stack(flags), axis=0))


def merge_results(count: int, row_results: Sequence[tuple[Indices, EnvResult]]) -> EnvResult:
    """Merge pairs (row indices, result) into one result of `count` environments; later pairs overwrite earlier ones."""
    if len(row_results) == 1 and len(row_results[0][0]) == count:
        return row_results[0][1]
    placed = [(move_to_device(rows, result.rewards), result) for rows, result in row_results]
    return EnvResult(*(_merge(count, [(rows, result[k]) for rows, result in placed]) for k in range(5)))


def copy_containers(result: EnvResult) -> EnvResult:
    """Return a result with new dictionaries but the same arrays, since callers (TorchRL) change the dictionaries."""
    copied: EnvResult = _select(result, slice(None))
    return copied


def select_rows(values: Any, rows: Indices | int) -> Any:
    """Return nested dictionaries and tuples of arrays with only some rows of each array; an int selects one row."""
    return _select(values, rows if isinstance(rows, int) else move_to_device(rows, values))


def _select(values: Any, rows: AnyArray | slice | int) -> Any:
    if isinstance(values, Mapping):
        return {key: _select(value, rows) for key, value in values.items()}
    if isinstance(values, tuple):
        chosen = [_select(value, rows) for value in values]
        return EnvResult(*chosen) if isinstance(values, EnvResult) else tuple(chosen)
    return values[rows]


def replace_rows(values: Any, rows: Indices, others: Any) -> Any:
    """Return copies of the arrays in nested dictionaries and tuples, with the rows `rows` taken from `others`."""
    count = len(_first_array(values))
    all_rows, replaced_rows = (move_to_device(indices, values) for indices in (np.arange(count), rows))
    return _merge(count, [(all_rows, values), (replaced_rows, others)])


def move_to_device(array: npt.NDArray[Any], values: Any) -> AnyArray:
    """Return a NumPy array as an array or tensor on the device of the arrays in the nested dictionaries `values`."""
    like = _first_array(values)
    return get_namespace(like).asarray(array, device=like.device)


def _merge(count: int, row_values: list[tuple[AnyArray, Any]]) -> Any:
    first = row_values[0][1]
    if isinstance(first, Mapping):
        return {key: _merge(count, [(rows, values[key]) for rows, values in row_values]) for key in first}
    if isinstance(first, tuple):
        return tuple(_merge(count, [(rows, values[k]) for rows, values in row_values]) for k in range(len(first)))
    xp, shape = get_namespace(first), (count, *first.shape[1:])
    dtype = xp.result_type(*(values.dtype for _, values in row_values))
    merged = xp.empty(shape, dtype=dtype, device=first.device)
    for rows, values in row_values:
        merged[rows] = xp.astype(values, dtype, copy=False)
    return merged


def mask_infos(infos: Mapping[str, AnyArray], mask: Flags, arrays: ArrayFactory) -> dict[str, AnyArray]:
    """Return infos (n, ...) in Gymnasium's form: KEY with zeros outside `mask` (n,), and `_KEY` with the mask."""
    masked, xp, chosen, is_complete = {}, arrays.xp, arrays.asarray(mask), mask.all()
    for key, values in infos.items():
        own = xp.reshape(chosen, (-1, *[1] * (values.ndim - 1)))
        masked[key] = xp.asarray(values, copy=True) if is_complete else xp.where(own, values, xp.zeros_like(values))
        masked[f"_{key}"] = xp.asarray(chosen, copy=True)
    return masked


def make_final_infos(
    observations: Any, infos: Mapping[str, AnyArray], ended: Flags, arrays: ArrayFactory
) -> dict[str, Any]:
    """Return an agent's infos in Gymnasium's form about episodes that ended in a step and were reset in it.

    Args:
        observations: Observations (n, ...) of the agent after the step, before the resets.
        infos: Infos (n,) of the agent after the step, before the resets.
        ended: Mask (n,) of the environments that were reset.
        arrays: Creator of the environments' arrays.

    Returns:
        Values of the keys "final_obs" and "final_info", and the masks "_final_obs" and "_final_info".
    """
    final_obs = np.full(len(ended), None, dtype=object)
    for row in np.flatnonzero(ended).tolist():
        final_obs[row] = select_rows(observations, row)
    masked, mask = mask_infos(infos, ended, arrays), arrays.asarray(ended.copy())
    return {"final_obs": final_obs, "_final_obs": ended.copy(), "final_info": masked, "_final_info": mask}


def _first_array(values: Any) -> AnyArray:
    while isinstance(values, (Mapping, tuple)):
        values = next(iter(values.values())) if isinstance(values, Mapping) else values[0]
    return values


class Envs(Protocol):
    """Interface of environments that are simulated together; `rows` are indices of environments, a NumPy array.

    Attributes:
        arrays: Creator of the arrays that `reset` and `step` return.
    """

    arrays: ArrayFactory

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes.

        Args:
            rows: Indices (r,) of the environments.
            seeds: Seed of each of these environments; None keeps the state of its random generators.
            options: Options of `HandoverEnv.reset`, the same for all.

        Returns:
            Result of the r environments, with rewards of 0.
        """

    def check_actions(self, actions: ByAgent) -> ByAgent:
        """Check the actions (n, ...) of all environments by agent, and return them as `step` takes them."""

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with checked actions (r, ...) by agent; return the result of these r."""

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""

    def close(self) -> None:
        """Free the simulation."""


class EnvBatch:
    """Batch of n environments, with the resets after an episode's end.

    Args:
        envs: The environments.
        action_spaces: Action space of each agent in one environment.
        num_envs: Number n of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.

    Attributes:
        arrays: Creator of the arrays that `reset` and `step` return.
        is_running: Whether every environment has been reset, and no reset or step has failed since.
    """

    def __init__(
        self, envs: Envs, action_spaces: Mapping[str, spaces.Space[Any]], num_envs: int, autoreset: AutoresetMode
    ) -> None:
        self.num_envs, self.autoreset, self.is_running = num_envs, autoreset, False
        self._is_closed, self._process, self._lock = False, os.getpid(), threading.Lock()
        self._envs, self.arrays, self._action_spaces = envs, envs.arrays, action_spaces
        self._ended = np.zeros(num_envs, dtype=bool)
        self._latest: EnvResult | None = None

    def __reduce__(self) -> NoReturn:
        raise OptionError("a vector environment cannot be copied or pickled; make another one, in its process")

    def reset(self, seed: int | Sequence[int | None] | None, options: dict[str, Any] | None) -> tuple[ByAgent, ByAgent]:
        """Start an episode in every environment, or in some.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a sequence with a
                seed for each environment; None keeps the state of all random generators.
            options: Options of `reset` that every environment gets, and `reset_mask`, a mask (n,) of the environments
                to reset; default: all.

        Returns:
            Observations of all environments by agent (the last ones of environments that were not reset), and infos in
            Gymnasium's form of the environments that were reset.

        Raises:
            OptionError: The number of seeds is not the number of environments, a seed is negative or not an integer,
                `options` is not a mapping, or the mask has a wrong shape or chooses no environment.
            ResetNeededError: The environments are closed, or were made by another process.
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
        seeds = self._spread_seeds(seed)
        with self._use_envs():
            is_running, self.is_running = self.is_running or len(rows) == self.num_envs, False
            row_results = [(rows, self._envs.reset(rows, [seeds[row] for row in rows.tolist()], others or None))]
            if self._latest is not None and len(rows) < self.num_envs:
                row_results.insert(0, (np.arange(self.num_envs), self._latest))
            result = merge_results(self.num_envs, row_results)
            infos = {agent: mask_infos(own, chosen, self.arrays) for agent, own in result.infos.items()}
            self.is_running, self._ended[rows] = is_running, False
        self._latest = copy_containers(result)
        return result.observations, infos

    def step(self, actions: ByAgent) -> EnvResult:
        """Step every environment, and reset environments whose episode has ended as `autoreset` specifies.

        Args:
            actions: Actions (n, ...) of each agent, arrays or tensors.

        Returns:
            Result of all environments; environments that were reset have the observations of the reset. The infos have
            Gymnasium's form, with the last observations and infos of episodes that ended and were reset.

        Raises:
            ActionError: An agent's actions are missing or malformed; no environment has advanced.
            ResetNeededError: There was no reset, a reset or step has failed since, or an episode has
                ended and autoreset is "disabled"; or the environments are closed, or were made by another process.
            SimulationError: Another thread is using the environments.
        """
        with self._use_envs():
            if not self.is_running or (self.autoreset is AutoresetMode.DISABLED and self._ended.any()):
                raise ResetNeededError("no episode is running; call reset() before step()")
            if not isinstance(actions, dict) or actions.keys() != self._action_spaces.keys():
                raise ActionError(f"actions must be a dict of arrays for {' and '.join(self._action_spaces)}")
            checked = self._envs.check_actions(
                {
                    agent: check_action_array(values, self._action_spaces[agent], self.num_envs, agent, self.arrays)
                    for agent, values in actions.items()
                }
            )
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
        """Free the simulations of all environments, which cannot be used afterwards."""
        self.is_running, self._is_closed = False, True
        self._envs.close()

    @contextlib.contextmanager
    def _use_envs(self) -> Iterator[None]:
        """Check that the environments can be used, and exclude other threads meanwhile."""
        if self._is_closed:
            raise ResetNeededError("the vector environment is closed; make another one")
        if os.getpid() != self._process:
            # Threads do not survive a fork, so the simulation would wait for them forever.
            raise ResetNeededError("the vector environment was made by another process; make it after the fork")
        if not self._lock.acquire(blocking=False):
            raise SimulationError("another thread is using the vector environment; call reset() and step() in turn")
        try:
            with contextlib.nullcontext() if self.arrays == NUMPY_ARRAYS else disable_gradients():
                yield
        finally:
            self._lock.release()

    def _spread_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Return a seed for each environment: `seed` + k for number k, its element of a sequence, or None."""
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
