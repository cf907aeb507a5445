"""Results of steps and resets of many environments as arrays, joined and divided by rows."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.envs.wrappers.wrapper import ByAgent

Rows = npt.NDArray[np.int_]
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
        """Whether each episode has ended, (r,)."""
        parts = [*self.terminated.values(), *self.truncated.values()]
        return np.asarray(np.any(parts, axis=0))


def merge_results(count: int, parts: Sequence[tuple[Rows, EnvResult]]) -> EnvResult:
    """Join results of different rows to one result of `count` rows; a later part replaces earlier parts."""
    if len(parts) == 1 and len(parts[0][0]) == count:
        return parts[0][1]
    return EnvResult(*(_merge(count, [(rows, result[k]) for rows, result in parts]) for k in range(5)))


def select_rows(values: Any, rows: Rows | int) -> Any:
    """Return some rows, or one, of the arrays in dictionaries and tuples."""
    if isinstance(values, Mapping):
        return {key: select_rows(value, rows) for key, value in values.items()}
    if isinstance(values, tuple):
        chosen = [select_rows(value, rows) for value in values]
        return EnvResult(*chosen) if isinstance(values, EnvResult) else tuple(chosen)
    return values[rows]


def replace_rows(values: Any, rows: Rows, others: Any) -> Any:
    """Return copies of the arrays in dictionaries and tuples, with some rows replaced."""
    count = len(_first_array(values))
    return _merge(count, [(np.arange(count), values), (rows, others)])


def _merge(count: int, parts: list[tuple[Rows, Any]]) -> Any:
    first = parts[0][1]
    if isinstance(first, Mapping):
        return {key: _merge(count, [(rows, values[key]) for rows, values in parts]) for key in first}
    if isinstance(first, tuple):
        return tuple(_merge(count, [(rows, values[k]) for rows, values in parts]) for k in range(len(first)))
    merged = np.empty((count, *first.shape[1:]), dtype=np.result_type(*(values.dtype for _, values in parts)))
    for rows, values in parts:
        merged[rows] = values
    return merged


def _first_array(values: Any) -> npt.NDArray[Any]:
    while isinstance(values, (Mapping, tuple)):
        values = next(iter(values.values())) if isinstance(values, Mapping) else values[0]
    return np.asarray(values)
