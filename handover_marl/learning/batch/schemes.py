"""Base classes of action schemes of many episodes at once.

Actions equal those of single episodes to 1e-6 after the rounding to float32, and do not depend on the
batch.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, to_numpy
from handover_marl.learning.action_scheme import ActionScheme
from handover_marl.learning.batch.grasp_selector import LowestCostGraspSelectorBatch


class SchemeBatch(ABC):
    """Decoder of network outputs into one agent's actions, in each of n episodes.

    Args:
        scheme: Scheme of a single episode; its parameters apply to all episodes.
        selector: Selector of grasps.
        count: Number n of episodes.
        arrays: Creator of the arrays.

    Attributes:
        size: Number of outputs.
    """

    def __init__(
        self,
        scheme: ActionScheme,
        selector: LowestCostGraspSelectorBatch,
        count: int,
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        self.size, self.wait = scheme.size, scheme.wait
        self._selector, self._arrays = selector, arrays
        self._outputs = arrays.zeros((count, scheme.size))

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode.

        Args:
            row: Index of the episode.
        """
        self._outputs[row] = 0.0

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the network must be evaluated now, in each of r episodes."""
        return self._arrays.full(len(rows), True, "bool")

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store new network outputs (r, size), clipped to [-1, 1]."""
        xp = self._arrays.xp
        self._outputs[rows] = xp.astype(outputs, xp.float64).clip(-1.0, 1.0)

    @abstractmethod
    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the agent's actions (r, ...) for the current outputs, float32.

        Args:
            rows: Indices (r,) of the episodes.
            observation: Arrays (r, ...) of the agent's observations.
        """


class RawSchemeBatch(SchemeBatch):
    """Batch of `RawScheme`: the outputs are the actions."""

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store new network outputs (r, size) without clipping."""
        xp = self._arrays.xp
        self._outputs[rows] = xp.astype(outputs, xp.float64)

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the current outputs as the actions, float32."""
        xp = self._arrays.xp
        return xp.astype(self._outputs[rows], xp.float32)


class SequentialSchemeBatch(SchemeBatch):
    """Batch of n user-defined schemes, one for each episode, that are called one after another with NumPy arrays.

    Args:
        schemes: Scheme of each episode.
        arrays: Creator of the actions.
    """

    def __init__(self, schemes: Sequence[ActionScheme], arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self.size = schemes[0].size
        self._schemes, self._arrays = schemes, arrays

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode."""
        self._schemes[row].reset()

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the network must be evaluated now, in each of r episodes."""
        needs = [scheme.needs_outputs(one) for scheme, one in self._pair(rows, observation)]
        return self._arrays.asarray(needs, "bool")

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store new network outputs (r, size)."""
        for row, own in zip(rows.tolist(), to_numpy(outputs), strict=True):
            self._schemes[row].set_outputs(own)

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the agent's actions (r, ...) for the current outputs."""
        actions = [scheme.compute_action(one) for scheme, one in self._pair(rows, observation)]
        return self._arrays.asarray(np.stack(actions))

    def _pair(self, rows: AnyArray, observation: Observation) -> Iterator[tuple[ActionScheme, Observation]]:
        own = {key: to_numpy(values) for key, values in observation.items()}
        for number, row in enumerate(rows.tolist()):
            yield self._schemes[row], {key: values[number].copy() for key, values in own.items()}
