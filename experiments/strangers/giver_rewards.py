"""Rewards that prefer a behavior of the giver, for the learned givers of the population `strangers-v1`.

    python experiments/training/train_ppo.py --agent giver --rewards experiments.strangers.giver_rewards:TURNING

Each reward weights events of the handover, as the behavior-preferring rewards of ZSC-Eval (Wang et al.,
NeurIPS 2024). The preference counts only in episodes that succeed, so that robots can take objects from the givers.
"""

from dataclasses import dataclass

import numpy as np

from handover_marl.envs.transition import Transition


@dataclass
class PreferenceReward:
    """Reward of the giver in the step that completes the handover: 1 plus weighted events of the episode.

    Events are measured in the last step in which the person holds the object, picked up and not released.
    Measured events have a sign, so that a giver near the recorded motion learns from the first update.

    Attributes:
        up: Weight of the wrist's displacement from the recording, upwards (m).
        turn: Weight of the hand's rotation from the recording about the vertical axis, counterclockwise (rad).
    """

    up: float = 0.0
    turn: float = 0.0

    def reset(self, transition: Transition) -> None:
        """Start an episode: clear the measured events."""
        self._preference = 0.0

    def __call__(self, transition: Transition) -> dict[str, dict[str, float]]:
        """Return the giver's terms of a step: `task`, 1 at a success, and `preference`, the weighted events then."""
        state = transition.state
        if state["holding"][0] and not state["released"][0]:
            displacement, rotation = np.split(state["deviation"][1:].astype(np.float64), 2)
            self._preference = float(self.up * displacement[2] + self.turn * rotation[2])
        task = float(transition.is_success)
        return {"giver": {"task": task, "preference": task * self._preference}, "receiver": {}}


#: Prefers to raise the object.
RAISING = PreferenceReward(up=8.0)
#: Prefers to turn the object counterclockwise, as seen from above.
TURNING = PreferenceReward(turn=2.0)
