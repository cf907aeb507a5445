"""Results of steps and resets of many environments as arrays, joined and divided by rows.

The arrays of one result are NumPy arrays, or PyTorch tensors on one device. Indices of environments are NumPy arrays.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, Indices, get_namespace, to_numpy

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
    """Join results of different rows to one result of `count` rows; later results replace earlier ones."""
    if len(row_results) == 1 and len(row_results[0][0]) == count:
        return row_results[0][1]
    placed = [(move_to_device(rows, result.rewards), result) for rows, result in row_results]
    return EnvResult(*(_merge(count, [(rows, result[k]) for rows, result in placed]) for k in range(5)))


def copy_containers(result: EnvResult) -> EnvResult:
    """Copy the dictionaries and tuples but not the arrays, since callers (TorchRL) change the dictionaries they get."""
    copied: EnvResult = _select(result, slice(None))
    return copied


def select_rows(values: Any, rows: Indices | int) -> Any:
    """Return some rows, or one, of the arrays in dictionaries and tuples."""
    return _select(values, rows if isinstance(rows, int) else move_to_device(rows, values))


def _select(values: Any, rows: AnyArray | slice | int) -> Any:
    if isinstance(values, Mapping):
        return {key: _select(value, rows) for key, value in values.items()}
    if isinstance(values, tuple):
        chosen = [_select(value, rows) for value in values]
        return EnvResult(*chosen) if isinstance(values, EnvResult) else tuple(chosen)
    return values[rows]


def replace_rows(values: Any, rows: Indices, others: Any) -> Any:
    """Return copies of the arrays in dictionaries and tuples, with some rows replaced."""
    count = len(_first_array(values))
    all_rows, replaced_rows = (move_to_device(indices, values) for indices in (np.arange(count), rows))
    return _merge(count, [(all_rows, values), (replaced_rows, others)])


def move_to_device(array: npt.NDArray[Any], values: Any) -> AnyArray:
    """Return a NumPy array in the namespace and on the device of the arrays in dictionaries and tuples."""
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
    """Return the infos of the environments in a mask in Gymnasium's form: zeros elsewhere, and masks."""
    masked, xp, chosen, is_complete = {}, arrays.xp, arrays.asarray(mask), mask.all()
    for key, values in infos.items():
        masked[key] = xp.asarray(values, copy=True) if is_complete else xp.where(chosen, values, xp.zeros_like(values))
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
