"""Recorded episode: arrays of observations and actions, its metadata, and its file (`.npz`)."""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl import __version__
from handover_marl.config import PANDA_DOF
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.result_folder import check_scalar
from handover_marl.execution.reading import read_arrays

_UNKNOWN = -1
_NUMBERS = ("scene_id", "release_step")  # that may be unknown
_OBSERVATION_PREFIX, _METADATA = "observations/", "metadata"
_MAX_BYTES = 8_000_000_000  # unpacked size of one episode
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
    return _decode_metadata(read_arrays(path, (_METADATA,), _MAX_BYTES)[_METADATA])


def read_transitions(
    path: Path, names: Iterable[str], space: spaces.Dict
) -> tuple[Observation, npt.NDArray[np.float32]]:
    """Read some observations (T + 1, ...) and the actions (T, 9) of an episode from its `.npz` file.

    Args:
        path: Path of the file.
        names: Keys of the observations.
        space: Observation space of the data set.

    Raises:
        Exception: The file is damaged; NumPy and zipfile raise exceptions of many types.
    """
    arrays = read_arrays(path, ("actions", *(_OBSERVATION_PREFIX + name for name in names)), _MAX_BYTES)
    _check_arrays(arrays, space)
    return {name: arrays[_OBSERVATION_PREFIX + name] for name in names}, arrays["actions"]


def read_demonstration(path: Path, space: spaces.Dict) -> Demonstration:
    """Read all arrays and the metadata of an episode from its `.npz` file.

    Args:
        path: Path of the file.
        space: Observation space of the data set.

    Raises:
        Exception: The file is damaged; NumPy and zipfile raise exceptions of many types.
    """
    arrays = read_arrays(path, largest=_MAX_BYTES)
    metadata = _decode_metadata(arrays.pop(_METADATA))
    _check_arrays(arrays, space)
    observations = {name: arrays[_OBSERVATION_PREFIX + name] for name in space}
    return Demonstration(observations, **{name: arrays[name] for name in _LAYOUT}, metadata=metadata)


def _decode_metadata(array: npt.NDArray[Any]) -> EpisodeMetadata:
    values = json.loads(array.item())
    types = {field.name: int if field.type in (int, "int") else str for field in fields(EpisodeMetadata)}
    return EpisodeMetadata(**{name: check_scalar(name, values[name], kind) for name, kind in types.items()})


def _check_arrays(arrays: Mapping[str, npt.NDArray[Any]], space: spaces.Dict) -> None:
    """Check lengths, shapes and types of an episode's arrays, and that actions and rewards are finite.

    Raises:
        ValueError: An array has another form.
        KeyError: An array is not one of an episode.
    """
    for name, array in arrays.items():
        key = name.removeprefix(_OBSERVATION_PREFIX)
        shape, dtype = _LAYOUT[name] if key == name else (space[key].shape or (), space[key].dtype)
        rows = len(arrays["giver_steps" if name.startswith("giver") else "actions"])
        rows += name == "steps" or key != name
        if array.shape != (rows, *shape) or array.dtype != np.dtype(dtype):
            raise ValueError(f"{name} must be {np.dtype(dtype)} {(rows, *shape)}, got {array.dtype} {array.shape}")
        if name.endswith(("actions", "rewards")) and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite")
