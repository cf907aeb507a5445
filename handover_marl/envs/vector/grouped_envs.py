"""Environments in groups, each simulated by a thread or a process of its own."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from handover_marl.envs.vector.batch import Envs
from handover_marl.envs.vector.results import EnvResult, merge_results, select_rows
from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.geometry.arrays import Indices


class GroupedEnvs:
    """Environments in groups that are simulated at the same time; see `batch.Envs`.

    Args:
        make: Function that makes the environments of a group, whose number it gets.
        count: Number of environments.
        n_groups: Number of groups, at least 2 and at most `count`.
    """

    def __init__(self, make: Callable[[int], Envs], count: int, n_groups: int) -> None:
        group_rows = np.array_split(np.arange(count), n_groups)
        self._groups = [make(len(rows)) for rows in group_rows]
        self._firsts = [int(rows[0]) for rows in group_rows]
        self.arrays = self._groups[0].arrays
        self._pool = ThreadPoolExecutor(n_groups)

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each."""

        def reset(group: Envs, own_rows: Indices, places: Indices) -> EnvResult:
            return group.reset(own_rows, [seeds[place] for place in places.tolist()], options)

        return self._map(rows, reset)

    def check_actions(self, actions: ByAgent) -> ByAgent:
        """Check the actions (n, ...) of all environments, and return them as `step` takes them."""
        return self._groups[0].check_actions(actions)

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with checked actions (r, ...) by agent."""
        return self._map(rows, lambda group, own_rows, places: group.step(own_rows, select_rows(actions, places)))

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        images = [image for group in self._groups for image in group.render() or ()]
        return images or None

    def close(self) -> None:
        """Free the simulations."""
        for group in self._groups:
            group.close()
        self._pool.shutdown()

    def _map(self, rows: Indices, function: Callable[[Envs, Indices, Indices], EnvResult]) -> EnvResult:
        """Call a function for each group with some of the environments `rows` (r,), and join the results.

        Args:
            rows: Indices of environments, ascending.
            function: Function of a group, indices in the group, and their places in `rows`.
        """
        numbers = np.searchsorted(self._firsts, rows, side="right") - 1
        futures, all_places = [], [np.flatnonzero(numbers == number) for number in range(len(self._groups))]
        for group, first, places in zip(self._groups, self._firsts, all_places, strict=True):
            if len(places):
                futures.append((places, self._pool.submit(function, group, rows[places] - first, places)))
        # All groups finish before the first error is raised.
        errors = [error for _, future in futures if (error := future.exception()) is not None]
        if errors:
            raise errors[0]
        return merge_results(len(rows), [(places, future.result()) for places, future in futures])
