"""Action schemes for givers."""

from abc import abstractmethod

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, GiverAction, giver_action_space
from handover_marl.givers.patience import Patience
from handover_marl.learning.features import offer_frame
from handover_marl.learning.scheme import Action, ActionScheme, Outputs, Raw
from handover_marl.policies.giver import deviation


class GiverRaw(Raw):
    """The giver's Box(8) as it is, in physical units."""

    name, agent, size = "giver", "giver", GIVER_ACTION_SIZE


class GiverScheme(ActionScheme):
    """A scheme that can also say which outputs come nearest to an action, to learn from other givers."""

    @abstractmethod
    def outputs(self, action: Action, observation: Observation) -> Outputs:
        """(size,) outputs, between -1 and 1, for a giver's action (8,)."""


class Deviation(GiverScheme):
    """The giver's Box(8), every component between -1 and 1; zero replays, the last one lets go above 0.5."""

    name, agent, size = "deviation", "giver", GIVER_ACTION_SIZE

    def action(self, observation: Observation) -> Action:
        """The outputs in physical units."""
        space = giver_action_space(self.context.config.giver)
        return np.clip(self._outputs * space.high, space.low, space.high).astype(np.float32)

    def outputs(self, action: Action, observation: Observation) -> Outputs:
        """The action as shares of its bounds."""
        return np.asarray(np.clip(action / giver_action_space(self.context.config.giver).high, -1.0, 1.0))


class Offer(GiverScheme):
    """One decision in an episode: where and how to hold the object out; and how far to draw back afterwards.

    Asked when the recording is about to arrive where it holds the object out. Until then it is replayed; after
    that nothing changes until the object has been let go, since robots take best what does not move; only when
    nobody comes for two seconds is the object offered otherwise (`handover_marl.givers.patience`).

    | outputs | meaning, at 1 |
    |---|---|
    | 0-2 | the object is 0.25 m nearer to the gripper, 0.25 m further to its left, 0.25 m higher |
    | 3-5 | hand and object are turned by 1 rad about these axes, about the object's middle |
    | 6 | the hand draws back by 0.3 m once the object has been let go; at -1 it stays |
    """

    name, agent, size = "offer", "giver", 7
    reach, turn, withdraw = 0.25, 1.0, 0.3  # m, rad, m
    at_rest = 0.01  # m, what the wrist may still move while arriving
    latest = 2.5  # s; by then it has to decide

    def reset(self) -> None:
        """Replay until asked."""
        super().reset()
        self._decided = self._chosen = False
        self._shift, self._turn = np.zeros(3), np.zeros(3)
        self._drawn_back: np.ndarray | None = None
        self._patience = Patience()

    def asks(self, observation: Observation) -> bool:
        """Once, when the recording is about to come to rest."""
        if self._decided or not observation["holding"][0] or not observation["hand_present"][0]:
            return False
        coming = observation["replay_wrist_poses"][2:, :3]
        arriving = float(np.abs(coming - coming[-1]).max()) < self.at_rest
        return arriving or float(observation["time"][0]) >= self.latest

    def decide(self, outputs: Outputs) -> None:
        """Take the outputs."""
        super().decide(outputs)
        self._decided = True

    def action(self, observation: Observation) -> Action:
        """Replay, hold out, or draw back."""
        if self._decided and not self._chosen:
            self._choose(observation)
        if self._chosen and observation["released"][0]:
            return self._draw_back(observation)
        if self._chosen:
            self._patience.watch(observation)
        share = self._patience.share
        return deviation(displacement=share * self._shift, rotation=share * self._turn)

    def outputs(self, action: Action, observation: Observation) -> Outputs:
        """What holds the object out as an action would; drawing back is left at half its length."""
        wanted = GiverAction.of(action)
        item, axes = offer_frame(observation)
        wrist = observation["replay_wrist_poses"][-1, :3].astype(np.float64)
        swung = wrist + Rotation.from_rotvec(wanted.rotation).apply(item - wrist)
        way = axes.T @ (swung + wanted.displacement - item) / self.reach
        return np.asarray(np.clip([*way, *(axes.T @ wanted.rotation / self.turn), 0.0], -1.0, 1.0))

    def _choose(self, observation: Observation) -> None:
        item, axes = offer_frame(observation)
        wrist = observation["replay_wrist_poses"][-1, :3].astype(np.float64)
        self._turn = axes @ self._outputs[3:6] * self.turn
        # The object swings about the wrist; the wrist makes up for it.
        swung = wrist + Rotation.from_rotvec(self._turn).apply(item - wrist)
        self._shift = item + axes @ self._outputs[:3] * self.reach - swung
        self._chosen = True

    def _draw_back(self, observation: Observation) -> Action:
        if self._drawn_back is None:
            away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
            length = (self._outputs[6] + 1.0) / 2.0 * self.withdraw
            shift = self._patience.share * self._shift
            self._drawn_back = shift + length * away / max(float(np.linalg.norm(away)), 1e-6)
        return deviation(displacement=self._drawn_back, rotation=self._patience.share * self._turn)
