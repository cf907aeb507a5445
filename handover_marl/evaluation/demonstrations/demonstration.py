"""Recorded episodes: arrays of observations and actions with their metadata, their files (`.npz`), and a reader."""

import contextlib
import io
import json
import operator
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import PANDA_DOF
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.observations import Observation, receiver_observation_space
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, check_obs_mode, receiver_action_space
from handover_marl.errors import DataFormatError, DataNotFoundError, check_name
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata, read_result_metadata
from handover_marl.evaluation.results.result_folder import (
    check_scalar,
    find_demonstrations,
    get_demonstrations_metadata_path,
    read_results,
)
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.version import __version__

_UNKNOWN = -1
_NUMBERS = ("scene_id", "release_step")  # that may be unknown
_OBSERVATION_PREFIX, _METADATA = "observations/", "metadata"
_MAX_BYTES = 8_000_000_000  # unpacked size of one episode
_MAX_METADATA_BYTES = 10_000
# Shape of a row and type of each array but observations.
_LAYOUT: dict[str, tuple[tuple[int, ...], type]] = {
    "actions": ((PANDA_DOF,), np.float32),
    "rewards": ((), np.float64),
    "terminations": ((), np.bool_),
    "truncations": ((), np.bool_),
    "steps": ((), np.int64),
    "giver_steps": ((), np.int64),
    "giver_actions": ((GIVER_ACTION_SIZE,), np.float32),
}


@dataclass(frozen=True)
class EpisodeMetadata:
    """Scene, policies and outcome of a recorded episode.

    Attributes:
        scene_id: Scene number.
        object_name: YCB class of the object handed over, e.g. "025_mug".
        subject: Person recorded in the scene.
        side: Hand that gives the object, "right" or "left".
        outcome: "success", or "contact", "drop", "timeout", joined by "+" if they coincide.
        status: Outcome of the episode as bits of `handover_marl.EpisodeStatus`.
        steps: Physics steps (1 ms) until the end of the episode.
        release_step: Physics step whose contacts made the giver release the object; -1 without release.
        receiver: Label of the robot's policy.
        giver: Label of the person's policy.
        physics: Kind of physics.
        dataset: Dataset of the scene.
        robot: Robot model, with or without the wrist camera.
        seed: Seed of policies, camera and initial joint positions.
        models: Description of the hand model and of other substitutes for HandoverSim's models; empty
            without substitutes.
        fingerprint: Hash of the scene's data files.
        version: Version of this library.
    """

    scene_id: int
    object_name: str
    subject: str
    side: str
    outcome: str
    status: int
    steps: int
    release_step: int
    receiver: str
    giver: str
    physics: str
    dataset: str
    robot: str
    seed: int
    models: str
    fingerprint: str
    version: str

    @classmethod
    def from_result(cls, result: EpisodeResult, config: EvaluationConfig) -> "EpisodeMetadata":
        """Create the metadata of an episode from its result and configuration.

        Args:
            result: Outcome of the episode.
            config: Resolved configuration of its evaluation.
        """
        policies = {agent: require_policy_reference(getattr(config, agent)).label for agent in ("receiver", "giver")}
        values: dict[str, Any] = {**vars(config), **vars(result), **policies, "version": __version__}
        values |= {"outcome": result.status.label, "status": int(result.status)}
        unknown = {name: _UNKNOWN if name in _NUMBERS else "" for name, value in values.items() if value is None}
        return cls(**{field.name: (values | unknown)[field.name] for field in fields(cls)})

    @property
    def success(self) -> bool:
        """Whether the handover was completed."""
        return self.outcome == "success"


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Recorded episode with T actions of the receiver and G decisions of the giver.

    Rows are the receiver's decisions, or frames at a constant rate (`fps`). The receiver's i-th action holds from
    physics step `steps[i]` on, that of a decision until `steps[i + 1]`; the giver's j-th action holds from
    `giver_steps[j]` until its next. Applied at these steps, decisions reproduce the episode bit for bit.

    Attributes:
        observations: Arrays (T + 1, ...) by key of `receiver_observation_space`, at every row and at the end.
        actions: (T, 9) float32 target joint positions, 7 arm joints (rad), 2 fingers (m).
        rewards: (T,) float64, 1 for the last row of a completed handover, else 0.
        terminations: (T,) bool, whether success, contact or a drop ended the episode.
        truncations: (T,) bool, whether the time limit ended the episode.
        steps: (T + 1,) int64 physics steps (1 ms) since the start, at every observation.
        giver_steps: (G,) int64 physics steps of the giver's decisions; empty for the replayed giver.
        giver_actions: (G, 8) float32 deviations from the replay, see `handover_marl.episode.spaces`.
        metadata: Scene, policies and outcome.
    """

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float64]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    steps: npt.NDArray[np.int64]
    giver_steps: npt.NDArray[np.int64]
    giver_actions: npt.NDArray[np.float32]
    metadata: EpisodeMetadata

    def __len__(self) -> int:
        """Return the number T of the receiver's actions."""
        return len(self.actions)

    def hold_giver_actions(self) -> npt.NDArray[np.float32]:
        """Return the giver's action (T + 1, 8) in effect from each of `steps` on; zeros replay the recording."""
        decisions = zip(self.giver_steps.tolist(), self.giver_actions, strict=True)
        return hold_actions([(0, NO_DEVIATION), *decisions], self.steps)


def hold_actions(
    decisions: Sequence[tuple[int, npt.NDArray[np.float32]]], steps: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Return the actions in effect from given physics steps on (zero-order hold).

    Args:
        decisions: Physics step and action of each decision, in order; the first is at step 0.
        steps: (T,) physics steps.
    """
    starts = [step for step, _ in decisions]
    last = np.searchsorted(starts, steps, side="right") - 1
    return np.stack([decisions[number][1] for number in last])


def encode_demonstration(demonstration: Demonstration) -> bytes:
    """Return the content of the episode's `.npz` file; equal episodes have equal content."""
    stream = io.BytesIO()
    observations = sorted(demonstration.observations.items())
    arrays: dict[str, Any] = {_OBSERVATION_PREFIX + name: array for name, array in observations}
    arrays |= {name: getattr(demonstration, name) for name in _LAYOUT}
    arrays[_METADATA] = np.array(json.dumps(asdict(demonstration.metadata)))
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def read_episode_metadata(path: Path) -> EpisodeMetadata:
    """Read the metadata of an episode from its `.npz` file.

    Raises:
        Exception: The file is damaged; NumPy and zipfile raise exceptions of many types.
    """
    values = json.loads(read_arrays(path, (_METADATA,), _MAX_BYTES)[_METADATA].item())
    types = {field.name: int if field.type in (int, "int") else str for field in fields(EpisodeMetadata)}
    return EpisodeMetadata(**{name: check_scalar(name, values[name], kind) for name, kind in types.items()})


def _read_episode_arrays(
    path: Path, space: spaces.Dict, observations: Iterable[str], names: Iterable[str]
) -> tuple[Observation, dict[str, npt.NDArray[Any]]]:
    """Read some observations by key, and some other arrays by name, of an episode in an observation space.

    Raises:
        Exception: The file is damaged, or an array has another shape or type, or actions or rewards are not finite.
    """
    keys = {_OBSERVATION_PREFIX + name: name for name in observations}
    arrays = read_arrays(path, (*keys, *{"actions", *names}), _MAX_BYTES)
    for name, array in arrays.items():
        is_observation = name in keys
        layout = (space[keys[name]].shape, space[keys[name]].dtype) if is_observation else _LAYOUT[name]
        rows = len(arrays["giver_steps" if name.startswith("giver") else "actions"])
        expected = (rows + (name == "steps" or is_observation), *(layout[0] or ())), np.dtype(layout[1])
        if (array.shape, array.dtype) != expected:
            raise ValueError(f"{name} must be {expected[1]} {expected[0]}, got {array.dtype} {array.shape}")
        if name.endswith(("actions", "rewards")) and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite")
    return {name: arrays[key] for key, name in keys.items()}, {name: arrays[name] for name in names}


class Demonstrations:
    """Sequence of the episodes that `demonstrate` recorded, as NumPy arrays: `demonstrations[0].actions`.

    Episodes are in the order of the split. No file stays open, so that the object can be pickled.

    Args:
        folder: Output folder of `demonstrate`, also of one that is not finished.

    Attributes:
        folder: Output folder of `demonstrate`.
        fps: Frames per second; None if the rows are the receiver's decisions.
        observation_space: Space of the recorded receiver's observations, a `gymnasium.spaces.Dict`.
        action_space: Space of the recorded receiver's actions, target positions of its 9 joints (rad, m).
        evaluation: Identity of the evaluation that was recorded.

    Raises:
        DataNotFoundError: The folder has no demonstrations.
        DataFormatError: The description of the demonstrations is damaged.
        ResultsError: The folder is no result folder.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = check_path("folder", folder)
        path = get_demonstrations_metadata_path(self.folder)
        if not path.exists():
            raise DataNotFoundError(
                f"{path} does not exist: the folder has no demonstrations; `handover-marl demonstrate --out` records "
                "them"
            )
        with _report_damage(path):
            content = json.loads(read_plain_file(path, _MAX_METADATA_BYTES))
            check_obs_mode(content["obs_mode"])
            largest_class = check_scalar("largest_class", content["largest_class"], int)
            self.observation_space = receiver_observation_space(content["obs_mode"], largest_class)
            fps = content["fps"]
            self.fps: int | None = None if fps is None else check_scalar("fps", fps, int)
        self.action_space: spaces.Box = receiver_action_space()
        self.evaluation: ResultMetadata = read_result_metadata(self.folder)
        self._paths = find_demonstrations(self.folder)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._paths)

    def __getitem__(self, number: int) -> Demonstration:
        """Read the episode of a given number, with all its arrays.

        Raises:
            TypeError: The number is not an integer; slices are not supported.
            IndexError: The number is out of range.
            DataFormatError: The file of the episode is damaged.
        """
        path = self._paths[operator.index(number)]
        with _report_damage(path):
            observations, arrays = _read_episode_arrays(path, self.observation_space, self.observation_space, _LAYOUT)
            return Demonstration(observations, **arrays, metadata=read_episode_metadata(path))

    def __iter__(self) -> Iterator[Demonstration]:
        return map(self.__getitem__, range(len(self)))

    def read_metadata(self) -> list[EpisodeMetadata]:
        """Read the metadata of every episode.

        Raises:
            DataFormatError: The file of an episode is damaged.
        """
        found = []
        for path in self._paths:
            with _report_damage(path):
                found.append(read_episode_metadata(path))
        return found

    def read_transitions(
        self, names: Iterable[str] | None = None, episodes: Iterable[int] | None = None
    ) -> tuple[Observation, npt.NDArray[np.float32]]:
        """Read observations and actions of several episodes, concatenated, for imitation learning.

        Args:
            names: Observations to read, by key; default: all.
            episodes: Episodes to read, by number; default: all.

        Returns:
            Observations (N, ...) by key and actions (N, 9) of N rows.

        Raises:
            UnknownNameError: Unknown observation.
            IndexError: The number of an episode is out of range.
            DataFormatError: The file of an episode is damaged.
        """
        names = list(self.observation_space.spaces if names is None else names)
        for name in names:
            check_name("observation", name, self.observation_space.spaces)
        paths = self._paths if episodes is None else [self._paths[number] for number in episodes]
        space = self.observation_space
        # Arrays without rows give concatenations without episodes their shape and type.
        parts = {name: [np.zeros((0, *(space[name].shape or ())), space[name].dtype)] for name in names}
        actions = [np.zeros((0, PANDA_DOF), np.float32)]
        for path in paths:
            with _report_damage(path):
                observations, arrays = _read_episode_arrays(path, space, names, ("actions",))
            actions.append(arrays["actions"])
            for name in names:
                parts[name].append(observations[name][:-1])
        return {name: np.concatenate(arrays) for name, arrays in parts.items()}, np.concatenate(actions)

    def __str__(self) -> str:
        source = self.evaluation
        outcomes = Counter(result.status.label for result in read_results(self.folder, allow_empty=True))
        counts = ", ".join(f"{name} {number}" for name, number in sorted(outcomes.items()))
        return (
            f"{len(self)} episodes of {source.receiver}, giver {source.giver}, {source.dataset}, {source.setup} "
            f"{source.split}, {source.physics} physics; {source.recorded}.\nSimulated: {outcomes.total()} ({counts}). "
            f"Files: {get_demonstrations_metadata_path(self.folder).parent}"
        )


@contextlib.contextmanager
def _report_damage(path: Path) -> Iterator[None]:
    """Report every exception of reading a file as damage.

    Raises:
        DataFormatError: The file cannot be read.
    """
    try:
        yield
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(
            f"{path} cannot be read ({shorten_text(error)}); remove it and run the same command again to record its "
            "episode again"
        ) from error
