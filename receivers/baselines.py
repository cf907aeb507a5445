"""Baselines for learned policies: the receiver `hold` never moves, `random` moves at random."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import receiver_action_space
from handover_marl.policies.policy import Action, PolicyContext, Receiver


class HoldReceiver(Receiver):
    """Receiver that stays at the start configuration with open fingers."""

    name = "hold"

    @property
    def wait(self) -> None:
        """Time before the receiver moves: None, since it never moves."""
        return None

    def reset(self, seed: int | None = None) -> None:
        """Do nothing; the receiver has no state."""

    def act(self, observation: Observation) -> Action:
        """Return the start configuration (9,) (rad, m) with open fingers as target, whatever the observation."""
        return np.array(self.context.panda.start_joints, dtype=np.float32)


class RandomReceiver(Receiver):
    """Receiver that draws target joint positions uniformly between the limits of the action space."""

    name = "random"

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self._rng = np.random.default_rng()

    def reset(self, seed: int | None = None) -> None:
        """Seed the random generator."""
        self._rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Action:
        """Return nine random target joint positions (rad, m), whatever the observation."""
        space = receiver_action_space()
        return self._rng.uniform(space.low, space.high).astype(np.float32)
