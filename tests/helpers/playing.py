"""Functions that play scenes, and a recorder of their steps, for tests."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import ActionRecorder, EpisodeCallback, run_episode
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.policies.policy import Policy


def play(
    episode: Episode, scene: Scene, receiver: Policy, giver: Policy | None = None, *callbacks: EpisodeCallback
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Play a scene to its end; return the actions (T, 9) and the receiver's planning times (T,) in s of all steps."""
    log = ActionRecorder()
    episode.reset(scene)
    run_episode(episode, receiver, giver, callbacks=(log, *callbacks))
    return log.actions, log.times


def observe_handover(scene: Scene, milliseconds: int) -> Observation:
    """Return the observation of a scene after some milliseconds in fast physics, with the robot at rest."""
    episode = Episode("fast")
    episode.reset(scene)
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), milliseconds)
    observation = episode.observe()
    episode.close()
    return observation


class StepRecorder(EpisodeCallback):
    """Callback that records what a function reads from the episode at the start and after every `period` steps."""

    def __init__(self, read: Callable[[Episode], Any], period: int = 1) -> None:
        self._read, self._period = read, period

    def on_reset(self, episode: Episode) -> None:
        self.rows = [self._read(episode)]

    def on_step(self, episode: Episode) -> None:
        if episode.steps % self._period == 0:
            self.rows.append(self._read(episode))
