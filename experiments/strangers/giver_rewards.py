"""Rewards that prefer a behaviour of the giver, for the learned givers of the population `strangers-v1`.

    python experiments/training/train_giver_sb3.py --rewards experiments.strangers.giver_rewards:TURNING --teacher ''

Each reward weights events of the handover, as the behaviour-preferring rewards of ZSC-Eval (Wang et al.,
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
        away: Weight of the wrist's displacement from the recording, away from the gripper's first position (m).
        up: Weight of the wrist's displacement from the recording, upwards (m).
        turn: Weight of the hand's rotation from the recording about the vertical axis, counterclockwise (rad).
        holding: Weight of the time for which the person has held the object (s).
    """

    away: float = 0.0
    up: float = 0.0
    turn: float = 0.0
    holding: float = 0.0

    def reset(self, transition: Transition) -> None:
        """Start an episode: store the gripper's first position and clear the measured events."""
        self._gripper = transition.state["gripper_pose"][:3].astype(np.float64)
        self._held, self._preference = 0.0, 0.0

    def __call__(self, transition: Transition) -> dict[str, dict[str, float]]:
        """Return the giver's terms of a step: `task`, 1 at a success, and `preference`, the weighted events then."""
        state = transition.state
        if state["holding"][0] and not state["released"][0]:
            self._held += transition.duration
            displacement, rotation = np.split(state["deviation"][1:].astype(np.float64), 2)
            outwards = state["object_poses"][0, :3] - self._gripper
            events = [displacement @ outwards / np.linalg.norm(outwards), displacement[2], rotation[2], self._held]
            self._preference = float(np.dot([self.away, self.up, self.turn, self.holding], events))
        task = float(transition.is_success)
        return {"giver": {"task": task, "preference": task * self._preference}, "receiver": {}}


#: Prefers to keep the object away from the robot.
RELUCTANT = PreferenceReward(away=8.0)
#: Prefers to raise the object.
RAISING = PreferenceReward(up=8.0)
#: Prefers to turn the object counterclockwise, as seen from above.
TURNING = PreferenceReward(turn=2.0)
#: Prefers a fast handover.
IMPATIENT = PreferenceReward(holding=-0.5)
