"""Recorded episodes as groups of an HDF5 file, in Minari's layout.

| name | shape | |
|---|---|---|
| observations/... | (T + 1, ...) | one array for each of the receiver's observations |
| actions | (T, 9) | |
| rewards, terminations, truncations | (T,) | |
| infos/steps | (T + 1,) | physics steps at the observations |

Attributes of the group are the fields of `EpisodeMetadata`, `id`, `total_steps` (T),
`options/scene_id` (resets an environment to the scene) and, if the giver decides, `giver_steps` and
`giver_actions`: other readers of Minari's layout expect T rows in every array of the group.
"""

import io
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.evaluation.demonstrations.demonstration import Demonstration, EpisodeMetadata
from handover_marl.evaluation.demonstrations.files import open_hdf5
from handover_marl.evaluation.results.result_folder import check_scalar

#: Name of the group in the file of a single episode.
SINGLE_EPISODE_GROUP = "episode"
_CHUNK_BYTES = 500_000  # compressed together
_MAX_ARRAY_BYTES = 8_000_000_000
_ARRAYS: dict[str, tuple[tuple[int, ...], type]] = {
    "actions": ((PANDA_DOF,), np.float32),
    "rewards": ((), np.float64),
    "terminations": ((), np.bool_),
    "truncations": ((), np.bool_),
}
_GIVER_ARRAYS = "giver_steps", "giver_actions"


def encode_episode(demonstration: Demonstration) -> bytes:
    """Return the content of an HDF5 file with one episode; equal episodes have equal content."""
    stream = io.BytesIO()
    with open_hdf5(stream, "w") as file:
        _write(file.create_group(SINGLE_EPISODE_GROUP), demonstration)
    return stream.getvalue()


def read_episode_metadata(group: Any) -> EpisodeMetadata:
    """Read the metadata of an episode from its HDF5 group.

    Raises:
        Exception: The group has no such attributes; h5py raises errors of many types on damaged files.
    """
    values = {
        field.name: check_scalar(field.name, group.attrs[field.name], int if field.type in (int, "int") else str)
        for field in fields(EpisodeMetadata)
    }
    return EpisodeMetadata(**values)


def read_observations(group: Any, names: Iterable[str], space: spaces.Dict) -> Observation:
    """Read named observation arrays (T + 1, ...) of an episode with T decisions.

    Args:
        group: HDF5 group of the episode.
        names: Keys of the observations.
        space: Observation space of the data set.

    Raises:
        Exception: An array is missing or damaged.
    """
    rows = _read_total_steps(group) + 1
    arrays = group["observations"]
    return {name: _read_array(arrays[name], rows, space[name].shape, space[name].dtype) for name in names}


def read_actions(group: Any) -> npt.NDArray[np.float32]:
    """Read the receiver's actions (T, 9) from the HDF5 group of an episode with T decisions.

    Raises:
        Exception: The array is missing or damaged.
    """
    return _read_finite_array(group, "actions", _read_total_steps(group))


def read_episode(group: Any, space: spaces.Dict) -> Demonstration:
    """Read all arrays and the metadata of a recorded episode.

    Args:
        group: HDF5 group of the episode.
        space: Observation space of the data set.

    Raises:
        Exception: An array or attribute is missing or damaged.
    """
    rows = _read_total_steps(group)
    arrays = {name: _read_finite_array(group, name, rows) for name in _ARRAYS}
    giver_steps, giver_actions = _read_giver(group.attrs)
    return Demonstration(
        observations=read_observations(group, space.spaces, space),
        **arrays,
        steps=_read_array(group["infos"]["steps"], rows + 1, (), np.int64),
        giver_steps=giver_steps,
        giver_actions=giver_actions,
        metadata=read_episode_metadata(group),
    )


def _write(group: Any, demonstration: Demonstration) -> None:
    for name, array in demonstration.observations.items():
        _write_array(group, f"observations/{name}", array)
    for name in _ARRAYS:
        _write_array(group, name, getattr(demonstration, name))
    _write_array(group, "infos/steps", demonstration.steps)
    attributes = asdict(demonstration.metadata)
    # Minari numbers the episodes of a data set; a single episode is the first.
    attributes |= {"id": 0, "total_steps": len(demonstration), "options/scene_id": demonstration.metadata.scene_id}
    if len(demonstration.giver_steps):
        attributes |= {name: getattr(demonstration, name) for name in _GIVER_ARRAYS}
    for name, value in attributes.items():
        group.attrs[name] = value


def _write_array(group: Any, name: str, array: npt.NDArray[Any]) -> None:
    """Write an array with lossless compression and checksums, which reveal damage."""
    row_bytes = max(1, array[:1].nbytes)
    chunks = (max(1, min(len(array), _CHUNK_BYTES // row_bytes)), *array.shape[1:])
    group.create_dataset(name, data=array, chunks=chunks, compression="gzip", shuffle=True, fletcher32=True)


def _read_total_steps(group: Any) -> int:
    steps: int = check_scalar("total_steps", group.attrs["total_steps"], int)
    if steps < 1:
        raise ValueError(f"total_steps must be positive, got {steps}")
    return steps


def _read_finite_array(group: Any, name: str, rows: int) -> npt.NDArray[Any]:
    array = _read_array(group[name], rows, *_ARRAYS[name])
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array


def _read_array(data: Any, rows: int, shape: tuple[int, ...] | None, dtype: Any) -> npt.NDArray[Any]:
    """Read an array after a check of its shape, type and size."""
    expected = (rows, *(shape or ()))
    if data.shape != expected or data.dtype != np.dtype(dtype):
        raise ValueError(f"{data.name} must be {np.dtype(dtype)} {expected}, got {data.dtype} {data.shape}")
    if data.size * data.dtype.itemsize > _MAX_ARRAY_BYTES:
        raise ValueError(f"{data.name} must have at most {_MAX_ARRAY_BYTES // 1_000_000_000} GB")
    array: npt.NDArray[Any] = data[()]
    return array


def _read_giver(attributes: Mapping[str, Any]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    if _GIVER_ARRAYS[0] not in attributes:
        return np.zeros(0, dtype=np.int64), np.zeros((0, GIVER_ACTION_SIZE), dtype=np.float32)
    steps, actions = (np.asarray(attributes[name]) for name in _GIVER_ARRAYS)
    if steps.dtype != np.int64 or actions.dtype != np.float32 or actions.shape != (len(steps), GIVER_ACTION_SIZE):
        raise ValueError(
            f"giver_actions must be float32 {(len(steps), GIVER_ACTION_SIZE)}, got {actions.dtype} {actions.shape}"
        )
    if not np.isfinite(actions).all():
        raise ValueError("giver_actions must be finite")
    return steps, actions
