"""Recorder of episodes at a constant frame rate, for LeRobot's format."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP
from handover_marl.episode.callbacks import PolicyDecision
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.observations import Observation
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.demonstrations.demonstration import EpisodeMetadata
from handover_marl.evaluation.demonstrations.lerobot.encoded_episode import EncodedEpisode
from handover_marl.evaluation.demonstrations.lerobot.features import make_columns
from handover_marl.evaluation.demonstrations.recorder import RecordingConfig, observe
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.writers import EpisodeRecorder

_STEPS_PER_SECOND = round(1.0 / TIME_STEP)
#: Largest frame rate: one frame for each physics step.
MAX_FPS = _STEPS_PER_SECOND


def compute_frame_step(number: int, fps: int) -> int:
    """Return the physics step nearest to a frame's time; the later one if two steps are equally near.

    Args:
        number: Number of the frame in its episode.
        fps: Frames per second.
    """
    return (2 * number * _STEPS_PER_SECOND + fps) // (2 * fps)


class LeRobotRecorder(EpisodeRecorder):
    """Recorder of observations at a constant frame rate, with the actions that hold at each frame.

    A frame has the observation at the physics step nearest to the frame's time, and the actions
    that are in effect from this step on (zero-order hold). The end of the episode has no action and
    no frame.

    Args:
        recording: Observation mode, frame rate, and choice of the episodes to record.
        config: Resolved configuration of the evaluation.
    """

    def __init__(self, recording: RecordingConfig, config: EvaluationConfig) -> None:
        self._recording, self._config, self._fps = recording, config, recording.fps
        self._observations: list[Observation] = []
        self._next_step = 0
        self._receiver_actions: list[tuple[int, npt.NDArray[np.float32]]] = []
        self._giver_actions: list[tuple[int, npt.NDArray[np.float32]]] = []

    def on_reset(self, episode: Episode) -> None:
        """Discard the recording of the previous episode; record the first frame."""
        for recorded in (self._observations, self._receiver_actions, self._giver_actions):
            recorded.clear()
        self._next_step = 0
        # The recorded motion is replayed until the giver's first decision.
        self._giver_actions.append((0, NO_DEVIATION))
        self.on_step(episode)

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        """Record new actions."""
        if decision.receiver_decided:
            self._receiver_actions.append((episode.steps, decision.receiver_action.copy()))
        if decision.giver_decided:
            self._giver_actions.append((episode.steps, decision.giver_action.copy()))

    def on_step(self, episode: Episode) -> None:
        """Record an observation if a frame falls on this physics step."""
        if episode.steps == self._next_step and not episode.status:
            self._observations.append(observe(episode, self._recording.obs_mode))
            self._next_step = compute_frame_step(len(self._observations), self._fps)

    def encode(self, result: EpisodeResult) -> bytes:
        """Return the episode as an archive; empty if it is not to be recorded."""
        if not self._recording.includes(result.status):
            return b""
        steps = np.array([compute_frame_step(number, self._fps) for number in range(len(self._observations))])
        observations = {
            name: np.stack([observation[name] for observation in self._observations]) for name in self._observations[0]
        }
        actions = hold_actions(self._receiver_actions, steps)
        columns = make_columns(observations, actions, hold_actions(self._giver_actions, steps), result.success)
        metadata = EpisodeMetadata.from_result(result, self._config)
        return EncodedEpisode.from_columns(columns, metadata, self._fps).to_archive()


def hold_actions(
    actions: list[tuple[int, npt.NDArray[np.float32]]], steps: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Return the actions in effect from given physics steps on (zero-order hold).

    Args:
        actions: Physics step and action of each decision, in order; the first is at step 0.
        steps: (T,) physics steps.
    """
    starts = [step for step, _ in actions]
    last = np.searchsorted(starts, steps, side="right") - 1
    return np.stack([actions[number][1] for number in last])
