"""Base classes of action schemes of many episodes at once.

Actions equal those of single episodes to 1e-6 after the rounding to float32, and do not depend on the
batch.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.learning.action_scheme import ActionScheme
from handover_marl.receivers.grasp_selection import GraspSelectionBatch

Actions = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]
Flags = npt.NDArray[np.bool_]


class SchemeBatch(ABC):
    """Decoder of network outputs into one agent's actions, in each of n episodes.

    Args:
        scheme: Scheme of a single episode; its parameters apply to all episodes.
        selection: Selector of grasps.
        count: Number n of episodes.

    Attributes:
        size: Number of outputs.
    """

    def __init__(self, scheme: ActionScheme, selection: GraspSelectionBatch, count: int) -> None:
        self.size, self.wait = scheme.size, scheme.wait
        self._selection = selection
        self._outputs = np.zeros((count, scheme.size))

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode.

        Args:
            row: Index of the episode.
        """
        self._outputs[row] = 0.0

    def needs_outputs(self, rows: Rows, observation: Observation) -> Flags:
        """Return whether the network must be evaluated now, in each of r episodes."""
        return np.ones(len(rows), dtype=bool)

    def set_outputs(self, rows: Rows, outputs: npt.NDArray[np.floating]) -> None:
        """Store new network outputs (r, size), clipped to [-1, 1]."""
        self._outputs[rows] = np.clip(outputs.astype(np.float64), -1.0, 1.0)

    @abstractmethod
    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the agent's actions (r, ...) for the current outputs.

        Args:
            rows: Indices (r,) of the episodes.
            observation: Arrays (r, ...) of the agent's observations.
        """


class RawSchemeBatch(SchemeBatch):
    """Batch of `RawScheme`: the outputs are the actions."""

    def set_outputs(self, rows: Rows, outputs: npt.NDArray[np.floating]) -> None:
        """Store new network outputs (r, size) without clipping."""
        self._outputs[rows] = outputs

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the current outputs as the actions, float32."""
        return self._outputs[rows].astype(np.float32)


class SequentialSchemeBatch(SchemeBatch):
    """Batch of n user-defined action schemes, one for each episode, that are called one after another.

    Args:
        schemes: Scheme of each episode.
    """

    def __init__(self, schemes: Sequence[ActionScheme]) -> None:
        self.size = schemes[0].size
        self._schemes = schemes

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode."""
        self._schemes[row].reset()

    def needs_outputs(self, rows: Rows, observation: Observation) -> Flags:
        """Return whether the network must be evaluated now, in each of r episodes."""
        return np.array([scheme.needs_outputs(one) for scheme, one in self._pair(rows, observation)], dtype=bool)

    def set_outputs(self, rows: Rows, outputs: npt.NDArray[np.floating]) -> None:
        """Store new network outputs (r, size)."""
        for row, own in zip(rows.tolist(), outputs, strict=True):
            self._schemes[row].set_outputs(own)

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the agent's actions (r, ...) for the current outputs."""
        return np.stack([scheme.compute_action(one) for scheme, one in self._pair(rows, observation)])

    def _pair(self, rows: Rows, observation: Observation) -> Iterator[tuple[ActionScheme, Observation]]:
        for number, row in enumerate(rows.tolist()):
            yield self._schemes[row], {key: values[number].copy() for key, values in observation.items()}
