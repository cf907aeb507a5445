"""Recording of demonstrations: evaluation on a train split that keeps one file per episode."""

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback, PolicyDecision
from handover_marl.episode.observations import Observation, select_receiver_observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, STATE, has_camera
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.benchmark import run_evaluations
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, ExecutionConfig, build_configs
from handover_marl.evaluation.demonstrations.demonstration import (
    Demonstration,
    Demonstrations,
    describe_camera,
    describe_demonstration,
    encode_demonstration,
    hold_actions,
    read_episode_metadata,
)
from handover_marl.evaluation.results import (
    DEMONSTRATIONS,
    DEMONSTRATIONS_METADATA,
    EpisodeRecorder,
    EpisodeResult,
    EpisodeWriter,
    get_result_path,
    read_results,
)
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import forward_signature
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.camera.renderers import resolve_renderer

#: Choices of the episodes to record.
ALL, SUCCESS = "all", "success"
#: Largest frame rate: one frame for each physics step.
MAX_FPS = round(1.0 / TIME_STEP)


@forward_signature(EvaluationConfig, ExecutionConfig)
def demonstrate(
    setup: str | None = None,
    split: str = "train",
    receiver: PolicyLike = "reactive",
    giver: PolicyLike = REPLAY,
    *,
    obs_mode: str = STATE,
    keep: str = ALL,
    fps: int | None = None,
    **options: Any,
) -> Demonstrations:
    """Record observations and actions of both agents on the scenes of a train split.

    Args:
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: "train"; other splits are not allowed.
        receiver: The policy to record, as for `benchmark`.
        giver: The person's policy, as for `evaluate_pair`.
        obs_mode: Observation mode of the recording, e.g. "state+rgbd"; independent of the receiver's own mode.
        keep: Episodes to record: "all", with their outcome, or only those that end in "success".
        fps: Frames per second (1 to 1000) of the rows; default: one row for each decision of the receiver, for replay.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`. The folder `out` gets
            the episodes, results and a report; an interrupted recording resumes there.

    Raises:
        OptionError: The split is not the train split, no output folder is given, or `fps` is out of range.
        UnknownNameError: Unknown observation mode or choice of episodes.
        HandoverError: The same errors as `evaluate_pair`.
    """
    config, execution = build_configs(options, setup=setup, split=split, receiver=receiver, giver=giver)
    check_name("keep", keep, (ALL, SUCCESS))
    if config.split != "train":
        raise OptionError(
            f"split must be 'train', got {config.split!r}: results on a split are invalid if its episodes were used "
            "for training"
        )
    if fps is not None and (isinstance(fps, bool) or not isinstance(fps, int) or not 1 <= fps <= MAX_FPS):
        raise OptionError(f"fps must be an integer from 1 to {MAX_FPS}, got {fps!r}")
    if execution.folder is None:
        raise OptionError("demonstrations need an output folder; pass out= (--out DIR)")
    if has_camera(obs_mode):
        resolve_renderer(config.sensors.renderer, config.physics)
    camera = config.sensors.describe(obs_mode, config.physics)
    recorded = ["demonstrations", f"{fps} fps" if fps else "", f"obs_mode {obs_mode}", camera]
    make_writer = functools.partial(DemonstrationWriter, obs_mode=obs_mode, keep=keep, fps=fps)
    run_evaluations([("", config)], execution, ", ".join(filter(None, recorded)), make_writer)
    for result in read_results(execution.folder):
        # An earlier run may have recorded it.
        if keep == SUCCESS and not result.success:
            get_result_path(execution.folder / DEMONSTRATIONS, result.index).unlink(missing_ok=True)
    return Demonstrations(execution.folder)


class DemonstrationRecorder(EpisodeCallback):
    """Recorder of both agents' actions, and of the receiver's observations in the observation mode `obs_mode`.

    Observations are recorded at every decision of the receiver, or with `fps` at a constant rate. A frame then has the
    observation at the physics step nearest to the frame's time, and the actions in effect from this step on.
    """

    def __init__(self, config: EvaluationConfig, obs_mode: str, fps: int | None) -> None:
        self._config, self._obs_mode, self._fps = config, obs_mode, fps
        self._observations: list[Observation] = []
        self._steps: list[int] = []
        self._receiver: list[tuple[int, npt.NDArray[np.float32]]] = []
        self._giver: list[tuple[int, npt.NDArray[np.float32]]] = []

    def on_reset(self, episode: Episode) -> None:
        """Discard the recording of the previous episode; with a frame rate, record the first frame."""
        self._observations, self._steps, self._receiver, self._giver = [], [], [], []
        self.on_step(episode)

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        """Record new actions, and without a frame rate the observation at a new action of the receiver."""
        if decision.receiver_action_changed:
            self._receiver.append((episode.steps, decision.receiver_action.copy()))
            if self._fps is None:
                self._record_observation(episode)
        if decision.giver_decided:
            self._giver.append((episode.steps, decision.giver_action.copy()))

    def on_step(self, episode: Episode) -> None:
        """Record an observation if a frame falls on this physics step."""
        fps = self._fps
        # The physics step nearest to the frame's time; the later one if two steps are equally near.
        if fps and not episode.status and episode.steps == (2 * len(self._steps) * MAX_FPS + fps) // (2 * fps):
            self._record_observation(episode)

    def on_end(self, episode: Episode) -> None:
        """Record the observation at the end of the episode."""
        self._record_observation(episode)

    def _record_observation(self, episode: Episode) -> None:
        state = {name: value.copy() for name, value in episode.observe().items()}
        images = episode.observe_camera(self._obs_mode)
        self._observations.append(select_receiver_observation(state, images, self._obs_mode))
        self._steps.append(episode.steps)

    def build(self, result: EpisodeResult) -> Demonstration:
        """Build the demonstration of the last episode, given the episode's result."""
        steps = np.array(self._steps, dtype=np.int64)
        is_last = np.arange(len(steps) - 1) == len(steps) - 2
        names = self._observations[0]
        return Demonstration(
            observations={name: np.stack([row[name] for row in self._observations]) for name in names},
            actions=hold_actions(self._receiver, steps[:-1]),
            rewards=(is_last & result.success).astype(np.float64),
            # As in the environments, contact or drop in the step of the time limit sets both.
            terminations=is_last & bool(result.status & ~EpisodeStatus.TIMEOUT),
            truncations=is_last & bool(result.status & EpisodeStatus.TIMEOUT),
            steps=steps,
            giver_steps=np.array([step for step, _ in self._giver], dtype=np.int64),
            giver_actions=np.array([action for _, action in self._giver], dtype=np.float32).reshape(
                -1, GIVER_ACTION_SIZE
            ),
            metadata=describe_demonstration(result, self._config),
        )


class DemonstrationWriter(EpisodeWriter):
    """Writer of demonstrations in a result folder: one file for each episode, and one that describes the data set.

    The arguments `obs_mode`, `keep` and `fps` are those of `demonstrate`.
    """

    def __init__(self, folder: Path, config: EvaluationConfig, obs_mode: str, keep: str, fps: int | None) -> None:
        super().__init__(folder / DEMONSTRATIONS)
        self._config, self._keep, self._obs_mode, self._fps = config, keep, obs_mode, fps
        largest_class = max(config.open_dataset().object_names)
        description: dict[str, Any] = {"obs_mode": obs_mode, "fps": fps, "largest_class": largest_class}
        if has_camera(obs_mode):
            description["cameras"] = [describe_camera(camera) for camera in config.sensors.cameras]
        write_atomically(self.path / DEMONSTRATIONS_METADATA, json.dumps(description) + "\n")

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create the recorder of observations and actions, and the function that returns an episode's file content."""
        recorder = DemonstrationRecorder(config, self._obs_mode, self._fps)
        return (
            recorder,
            lambda result, _: encode_demonstration(recorder.build(result)) if self._includes(result) else b"",
        )

    def contains(self, result: EpisodeResult) -> bool:
        """Return whether the episode has a file of the same evaluation already, or is not to be recorded."""
        if not self._includes(result):
            return True
        try:
            stored = read_episode_metadata(self.get_path(result))
        except Exception:  # damaged files raise exceptions of many types; their episodes are simulated again
            return False
        return stored == describe_demonstration(result, self._config)

    def _includes(self, result: EpisodeResult) -> bool:
        return result.success or self._keep == ALL
