"""Recorded episodes: arrays of observations and actions with their metadata, their files (`.npz`), and a reader."""

import json
import operator
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import PANDA_DOF, CameraConfig
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.observations import Observation, receiver_observation_space
from handover_marl.episode.spaces import receiver_action_space
from handover_marl.errors import DataNotFoundError, check_name
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference
from handover_marl.evaluation.metadata import ResultMetadata, read_result_metadata
from handover_marl.evaluation.results import (
    DEMONSTRATIONS,
    DEMONSTRATIONS_METADATA,
    EpisodeResult,
    describe_episode,
    find_numbered,
    read_results,
)
from handover_marl.execution.files import encode_arrays
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_arrays, read_plain_file, report_damage
from handover_marl.simulation.camera.optics import CameraInfo, make_camera_info
from handover_marl.version import __version__

# Keys of the metadata, and values in place of unknown ones, by key.
_METADATA_KEYS = (
    *("scene_id", "object_name", "subject", "side", "outcome", "status", "steps", "release_step", "receiver", "giver"),
    *("physics", "dataset", "robot", "seed", "models", "fingerprint", "version"),
)
_UNKNOWN: dict[str, Any] = {"release_step": -1}
_OBSERVATION_PREFIX, _METADATA = "observations/", "metadata"
_MAX_BYTES = 8_000_000_000  # unpacked size of one episode
_MAX_METADATA_BYTES = 10_000
_KIND_AND_ADVICE = "demonstration", "remove it and run the same command again to record its episode again"
_ARRAYS = ("actions", "rewards", "terminations", "truncations", "steps", "giver_steps", "giver_actions")


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Recorded episode with T rows (observations and actions of the receiver) and G decisions of the giver.

    A row is a decision of the receiver (with inference time, the step at which a new action takes effect), or a frame
    at a constant rate (`fps`). The i-th action is in effect from physics step `steps[i]` on; if rows are decisions,
    until `steps[i + 1]`. The giver's j-th action is in effect from `giver_steps[j]` until the giver's next decision.
    Decisions that are applied at these steps reproduce the episode bit for bit.

    Attributes:
        observations: Arrays (T + 1, ...) by key of `receiver_observation_space`, at every row and at the end.
        actions: (T, 9) float32 target joint positions, 7 arm joints (rad), 2 fingers (m).
        rewards: (T,) float64, 1 for the last row of a completed handover, else 0.
        terminations: (T,) bool, True in the last row if success, contact or a drop ended the episode.
        truncations: (T,) bool, True in the last row if the time limit ended the episode.
        steps: (T + 1,) int64 physics steps (1 ms) since the start, at every observation.
        giver_steps: (G,) int64 physics steps of the giver's decisions; empty for the replayed giver.
        giver_actions: (G, 8) float32 deviations from the replay, see `handover_marl.episode.spaces`.
        metadata: Scene, policies and outcome as numbers and texts, by key: `scene_id`, `object_name` (class of the
            object), `subject` (person), `side` ("right" or "left"), `outcome` ("success", or "contact", "drop",
            "timeout", joined by "+" if they coincide), `status` (the same as bits of `handover_marl.EpisodeStatus`),
            `steps`, `release_step` (-1 without release), `receiver`, `giver`, `physics`, `dataset`, `robot`, `seed`,
            `models` (substitutes for HandoverSim's models), `fingerprint` (hash of the scene's files) and `version`.
    """

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float64]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    steps: npt.NDArray[np.int64]
    giver_steps: npt.NDArray[np.int64]
    giver_actions: npt.NDArray[np.float32]
    metadata: dict[str, Any]

    def __len__(self) -> int:
        """Return the number T of rows."""
        return len(self.actions)

    def hold_giver_actions(self) -> npt.NDArray[np.float32]:
        """Return the giver's actions (T + 1, 8) in effect from each of `steps` on; zeros mean no deviation."""
        decisions = zip(self.giver_steps.tolist(), self.giver_actions, strict=True)
        return hold_actions([(0, NO_DEVIATION), *decisions], self.steps)


def hold_actions(
    decisions: Sequence[tuple[int, npt.NDArray[np.float32]]], steps: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Return the actions (T, n) in effect at each of the physics `steps` (T,) (zero-order hold).

    `decisions` has the physics step and action (n,) of each decision, in order; the first is at step 0.
    """
    starts = [step for step, _ in decisions]
    last = np.searchsorted(starts, steps, side="right") - 1
    return np.stack([decisions[number][1] for number in last])


def describe_demonstration(result: EpisodeResult, config: EvaluationConfig) -> dict[str, Any]:
    """Return an episode's metadata by key, see `Demonstration.metadata`; `config` is resolved (`resolve_config`)."""
    policies = {agent: require_policy_reference(getattr(config, agent)).label for agent in ("receiver", "giver")}
    values = {**vars(config), **describe_episode(result), **policies, "version": __version__}
    return {key: _UNKNOWN.get(key, "") if values[key] is None else values[key] for key in _METADATA_KEYS}


def describe_camera(camera: CameraConfig) -> dict[str, Any]:
    """Return a camera's configuration as JSON types by key, with the matrices K and extrinsics of `CameraInfo`."""
    info = make_camera_info(camera)
    return {**asdict(camera), "K": info.K.tolist(), "extrinsics": info.extrinsics.tolist()}


def _read_camera(values: Mapping[str, Any]) -> CameraConfig:
    own: dict[str, Any] = {key: value for key, value in values.items() if key not in ("K", "extrinsics")}
    return CameraConfig(**own)


def encode_demonstration(demonstration: Demonstration) -> bytes:
    """Return the content of the episode's `.npz` file; equal episodes have equal content."""
    observations = sorted(demonstration.observations.items())
    arrays: dict[str, Any] = {_OBSERVATION_PREFIX + name: array for name, array in observations}
    arrays |= {name: getattr(demonstration, name) for name in _ARRAYS}
    arrays[_METADATA] = np.array(json.dumps(demonstration.metadata))
    return encode_arrays(arrays)


def read_episode_metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of an episode by key from its `.npz` file, see `Demonstration.metadata`."""
    values = json.loads(read_arrays(path, (_METADATA,), _MAX_BYTES)[_METADATA].item())
    return {name: values[name] for name in _METADATA_KEYS}


class Demonstrations:
    """Sequence of the episodes that `demonstrate` recorded, as NumPy arrays: `demonstrations[0].actions`.

    Episodes are in the order of the split. No file stays open, so that the object can be pickled.

    Args:
        folder: Output folder of `demonstrate`; the recording need not be finished.

    Attributes:
        folder: Path of this folder.
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
        path = self.folder / DEMONSTRATIONS / DEMONSTRATIONS_METADATA
        if not path.exists():
            raise DataNotFoundError(
                f"{path} does not exist: the folder has no demonstrations; `handover-marl demonstrate --out` records "
                "them"
            )
        with report_damage(path, *_KIND_AND_ADVICE):
            content = json.loads(read_plain_file(path, _MAX_METADATA_BYTES))
            cameras = [_read_camera(values) for values in content.get("cameras", [])]
            self.observation_space = receiver_observation_space(content["obs_mode"], content["largest_class"], cameras)
            self._cameras = cameras
            self.fps: int | None = content["fps"]
        self.action_space: spaces.Box = receiver_action_space()
        self.evaluation: ResultMetadata = read_result_metadata(self.folder)
        self._paths = list(find_numbered(path.parent, ".npz").values())

    def camera_info(self) -> dict[str, CameraInfo]:
        """Return the calibration (image size, intrinsics, pose) of each recorded camera, by the camera's name."""
        return {camera.name: make_camera_info(camera) for camera in self._cameras}

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._paths)

    def __getitem__(self, number: int) -> Demonstration:
        """Read the episode at an index of this sequence, with all its arrays.

        Raises:
            TypeError: The index is not an integer; slices are not supported.
            IndexError: The index is out of range.
            DataFormatError: The file of the episode is damaged.
        """
        return self._read(operator.index(number), self.observation_space)

    def __iter__(self) -> Iterator[Demonstration]:
        return map(self.__getitem__, range(len(self)))

    def read_metadata(self) -> list[dict[str, Any]]:
        """Read the metadata of every episode (scene, policies, outcome), see `Demonstration.metadata`.

        Raises:
            DataFormatError: The file of an episode is damaged.
        """
        found = []
        for path in self._paths:
            with report_damage(path, *_KIND_AND_ADVICE):
                found.append(read_episode_metadata(path))
        return found

    def read_transitions(
        self, names: Iterable[str] | None = None, episodes: Iterable[int] | None = None
    ) -> tuple[Observation, npt.NDArray[np.float32]]:
        """Read observations and actions of several episodes, concatenated, for imitation learning.

        Args:
            names: Observations to read, by key; default: all.
            episodes: Indices of the episodes to read; default: all.

        Returns:
            Observations (N, ...) by key, and actions (N, 9); N is the total number of rows (`Demonstration`).

        Raises:
            UnknownNameError: Unknown observation.
            IndexError: The index of an episode is out of range.
            DataFormatError: The file of an episode is damaged.
        """
        names = list(self.observation_space.spaces if names is None else names)
        for name in names:
            check_name("observation", name, self.observation_space.spaces)
        space = self.observation_space
        # Arrays without rows give concatenations without episodes their shape and type.
        parts = {name: [np.zeros((0, *(space[name].shape or ())), space[name].dtype)] for name in names}
        actions = [np.zeros((0, PANDA_DOF), np.float32)]
        for number in range(len(self)) if episodes is None else episodes:
            demonstration = self._read(number, names)
            actions.append(demonstration.actions)
            for name in names:
                parts[name].append(demonstration.observations[name][:-1])
        return {name: np.concatenate(arrays) for name, arrays in parts.items()}, np.concatenate(actions)

    def _read(self, number: int, names: Iterable[str]) -> Demonstration:
        """Read the episode at an index, with the observations `names`; errors are those of `__getitem__`."""
        path, keys = self._paths[number], {_OBSERVATION_PREFIX + name: name for name in names}
        with report_damage(path, *_KIND_AND_ADVICE):
            arrays = read_arrays(path, (*keys, *_ARRAYS), _MAX_BYTES)
            n_rows = len(arrays["actions"])
            if {len(arrays[name]) for name in ("steps", *keys)} != {n_rows + 1}:
                raise ValueError(f"observations must have {n_rows + 1} rows, one more than actions")
            observations = {name: arrays.pop(key) for key, name in keys.items()}
            return Demonstration(observations, **arrays, metadata=read_episode_metadata(path))

    def __str__(self) -> str:
        source = self.evaluation
        outcomes = Counter(result.status.label for result in read_results(self.folder, allow_empty=True))
        counts = ", ".join(f"{name} {number}" for name, number in sorted(outcomes.items()))
        return (
            f"{len(self)} episodes of {source.receiver}, giver {source.giver}, {source.dataset}, {source.setup} "
            f"{source.split}, {source.physics} physics; {source.recorded}.\nSimulated: {outcomes.total()} ({counts}). "
            f"Files: {self.folder / DEMONSTRATIONS}"
        )
