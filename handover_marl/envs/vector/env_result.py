"""Interface of environments that are simulated together, and results of their steps."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.episode.spaces import check_vector
from handover_marl.errors import ActionError
from handover_marl.geometry.arrays import (
    NUMPY_ARRAYS,
    AnyArray,
    ArrayFactory,
    Indices,
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
        infos: Infos: dictionaries of arrays. If some environments lack a key KEY, the array has zeros in their rows,
            and the mask (r,) under `_KEY` is False there.
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
    return EnvResult(*(merge_values(count, [(rows, result[k]) for rows, result in placed]) for k in range(5)))


def select_rows(values: Any, rows: Indices | int) -> Any:
    """Return nested dictionaries and tuples of arrays with only some rows of each array; an int removes the axis."""
    return _select(values, rows if isinstance(rows, int) else move_to_device(rows, values))


def _select(values: Any, rows: AnyArray | slice | int) -> Any:
    if isinstance(values, Mapping):
        return {key: _select(value, rows) for key, value in values.items()}
    if isinstance(values, tuple):
        chosen = [_select(value, rows) for value in values]
        return EnvResult(*chosen) if isinstance(values, EnvResult) else tuple(chosen)
    return values[rows]


def move_to_device(array: npt.NDArray[Any], values: Any) -> AnyArray:
    """Convert a NumPy array to the kind and device of the arrays in the nested dictionaries `values`."""
    like = _first_array(values)
    return get_namespace(like).asarray(array, device=like.device)


def merge_values(count: int, row_values: Sequence[tuple[AnyArray, Any]]) -> Any:
    """Merge pairs (row indices, nested dictionaries and tuples of arrays) into arrays of `count` rows.

    Dictionaries may differ in their keys; see the attribute `infos` of `EnvResult`.
    """
    first = next(values for _, values in row_values if values is not None)
    if isinstance(first, Mapping):
        if any(values.keys() != first.keys() for _, values in row_values):
            # Only infos of single environments differ, which are NumPy arrays.
            row_values = [(rows, _add_masks(values, np.ones(len(rows), dtype=bool))) for rows, values in row_values]
        keys = dict.fromkeys(key for _, values in row_values for key in values)
        return {key: merge_values(count, [(rows, values.get(key)) for rows, values in row_values]) for key in keys}
    if isinstance(first, tuple):
        return tuple(merge_values(count, [(rows, part[k]) for rows, part in row_values]) for k in range(len(first)))
    xp, shape = get_namespace(first), (count, *first.shape[1:])
    dtype = xp.result_type(*(values.dtype for _, values in row_values if values is not None))
    merged = xp.zeros(shape, dtype=dtype, device=first.device)
    for rows, values in row_values:
        merged[rows] = xp.zeros_like(merged[rows]) if values is None else xp.astype(values, dtype, copy=False)
    return merged


def _add_masks(infos: Mapping[str, AnyArray], every: Flags) -> dict[str, AnyArray]:
    """Return infos (r, ...) with a mask under `_KEY` for each key KEY; `every` (r,) is the mask of keys without one."""
    return {f"_{key}": every for key in infos if not _is_mask(key, infos)} | dict(infos)


def _is_mask(key: str, infos: Mapping[str, AnyArray]) -> bool:
    return key[:1] == "_" and key[1:] in infos


def mask_infos(infos: Mapping[str, AnyArray], mask: Flags, arrays: ArrayFactory) -> dict[str, AnyArray]:
    """Return infos (n, ...) in Gymnasium's form: KEY, zeros outside `mask` (n,), and `_KEY`, the rows that have KEY."""
    masked, xp, chosen, is_complete = {}, arrays.xp, arrays.asarray(mask), mask.all()
    for key in [key for key in infos if not _is_mask(key, infos)]:
        values, has_key = infos[key], chosen & infos.get(f"_{key}", True)
        own = xp.reshape(chosen, (-1, *[1] * (values.ndim - 1)))
        masked[key] = xp.asarray(values, copy=True) if is_complete else xp.where(own, values, xp.zeros_like(values))
        masked[f"_{key}"] = xp.asarray(has_key, copy=True)
    return masked


def make_final_infos(
    observations: Any, infos: Mapping[str, AnyArray], ended: Flags, arrays: ArrayFactory
) -> dict[str, Any]:
    """Return the keys "final_obs" and "final_info" of an agent's infos, and their masks, in Gymnasium's form.

    Observations and infos (n, ...) are those after the step, before the resets; `ended` (n,) masks the ended episodes.
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


class EnvGroup(Protocol):
    """Interface of environments that are simulated together; the attribute `arrays` creates their arrays.

    The argument `rows` (r,) of methods is a NumPy array with the indices of environments.
    """

    arrays: ArrayFactory

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start an episode in each environment of `rows`; return the first observations and infos (r, ...).

        `seeds` has r seeds; None keeps the state of an environment's random generators. `options` are those of
        `HandoverEnv.reset`, for all r environments.
        """

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` and return their result; actions (r, ...) have passed `check_action_array`."""

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""

    def close(self) -> None:
        """Free the simulation."""


def check_action_array(
    actions: Any, space: spaces.Space[Any], count: int, agent: str, arrays: ArrayFactory = NUMPY_ARRAYS, idle: Any = ()
) -> AnyArray:
    """Return an agent's actions (count, ...) as a float32 array or tensor; raise ActionError if they are malformed.

    `arrays` creates the result. Rows with the indices `idle` need not be finite: these environments ignore actions.
    """
    shape = (count, *(space.shape or ()))
    if is_tensor(actions) and arrays is not NUMPY_ARRAYS:
        is_number = arrays.xp.isdtype(actions.dtype, ("integral", "real floating"))
        gradient = " with a gradient; pass tensor.detach()" if actions.requires_grad else ""
        values = actions
    else:
        try:
            values = np.asarray(actions)
        except (ValueError, TypeError, RuntimeError) as error:  # ragged lists, tensors with a gradient or on a GPU
            raise ActionError(f"actions of the {agent} must be an array of shape {shape} ({error})") from error
        is_number, gradient = values.dtype.kind in "fiu", ""
    if tuple(values.shape) != shape or not is_number or gradient:
        raise ActionError(
            f"actions of the {agent} must have shape {shape}, got {values.dtype} {tuple(values.shape)}{gradient}"
        )
    xp = get_namespace(values)
    with np.errstate(over="ignore"):
        values = arrays.asarray(xp.astype(values, xp.float32))
    xp = arrays.xp
    if not xp.all(xp.isfinite(values)):
        for row in np.delete(to_numpy(values).reshape(count, -1), idle, axis=0):
            check_vector(f"action of the {agent}", row, len(row), "elements of its action space")
    return values
