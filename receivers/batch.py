"""Receivers that act in many episodes at once, on arrays with the episode as first axis."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.episode.loop import steps_from_hold_time
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIntegers, Indices
from handover_marl.policies.batch import ArrayPolicy, PolicyBatch
from handover_marl.policies.policy import Policy
from handover_marl.receivers.yang2021 import Yang2021Receiver
from handover_marl.receivers.yang2021_controller import YangController

Actions = npt.NDArray[np.float32]


class Yang2021Batch(ArrayPolicy[Yang2021Receiver]):
    """Batch of `Yang2021Receiver`, whose actions equal those of single receivers to the bit."""

    def __init__(self, policy: Yang2021Receiver, count: int) -> None:
        super().__init__(policy, count)
        self._controller = YangController(policy.context, policy.config, count)

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start an episode, and read the grasps of its object; see `PolicyBatch.reset`."""
        self._controller.prepare(object_names[0])
        super().reset(row, seed, object_names)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode; the receiver is deterministic."""
        self._controller.reset(np.array([row]))

    def decide(self, rows: Indices, observation: Observation) -> Actions:
        """Return the next target joint positions (r, 9) (rad, m)."""
        return self._controller.act(rows, observation)

    def count_hold_steps(self, rows: Indices) -> AnyIntegers:
        """Return the physics steps (r,) until the next decisions."""
        return np.array([steps_from_hold_time(time) for time in self._controller.get_hold_times(rows).tolist()])


def make_receiver_batch(policy: Policy, count: int) -> PolicyBatch | None:
    """Return the batch of a scripted receiver, or None for a receiver that has none.

    Args:
        policy: Receiver of a single episode. A subclass of a scripted receiver has no batch.
        count: Number of episodes.
    """
    return Yang2021Batch(policy, count) if type(policy) is Yang2021Receiver else None
