"""Wrapper that offsets the joint targets of a receiver, to measure how sensitive outcomes are to them."""

from collections.abc import Sequence

import numpy as np

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Policy, Receiver


class PerturbedReceiver(Receiver):
    """Wrapper of a receiver that adds a constant offset to the arm's joint targets.

    Args:
        receiver: Receiver to wrap.
        offset: Magnitude of the offset of each joint target (rad).
        seed: Seed of the signs of the offsets, an integer or several.
    """

    name = "perturbed"

    def __init__(self, receiver: Policy, offset: float, seed: int | Sequence[int]) -> None:
        super().__init__()
        self._receiver = receiver
        self.obs_mode = receiver.obs_mode
        self._offsets = offset * np.random.default_rng(seed).choice([-1.0, 1.0], ARM_DOF)

    def prepare(self, object_names: Sequence[str]) -> None:
        """Prepare the wrapped receiver."""
        self._receiver.prepare(object_names)

    @property
    def hold_time(self) -> float:
        """Time (s) for which the last action of the wrapped receiver is held."""
        return self._receiver.hold_time

    def reset(self, seed: int | None = None) -> None:
        """Start an episode of the wrapped receiver."""
        self._receiver.reset(seed)

    def act(self, observation: Observation) -> Action:
        """Return the wrapped receiver's action (9,), with the offsets added to the seven arm targets (rad)."""
        action = np.array(self._receiver.act(observation), dtype=np.float32)
        action[:ARM_DOF] += self._offsets.astype(np.float32)
        return action
