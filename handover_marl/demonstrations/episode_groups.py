"""An episode as a group of an HDF5 file, in Minari's layout.

| name | shape | |
|---|---|---|
| observations/... | (T + 1, ...) | one array for each of the receiver's observations |
| actions | (T, 9) | |
| rewards, terminations, truncations | (T,) | |
| infos/steps | (T + 1,) | physics steps at the observations |

The facts are attributes of the group, as are `id`, `total_steps` (T), `options/scene_id` (what resets an environment to
the scene) and, where a giver was asked, `giver_steps` and `giver_actions`: other readers of Minari's layout take every
array in the group for one of T rows.
"""

import io
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import PANDA_DOF
from handover_marl.demonstrations.demonstration import Demonstration, EpisodeFacts, checked_value
from handover_marl.demonstrations.hdf5 import open_hdf5
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE

#: The group in the file of a single episode.
SINGLE = "episode"
_CHUNK = 500_000  # bytes that are packed together
_LARGEST = 8_000_000_000  # bytes of an array, unpacked
_PLAIN: dict[str, tuple[tuple[int, ...], type]] = {
    "actions": ((PANDA_DOF,), np.float32),
    "rewards": ((), np.float64),
    "terminations": ((), np.bool_),
    "truncations": ((), np.bool_),
}
_GIVER = "giver_steps", "giver_actions"


def episode_file(demonstration: Demonstration) -> bytes:
    """The file of a single episode; equal for equal episodes."""
    stream = io.BytesIO()
    with open_hdf5(stream, "w") as file:
        _write(file.create_group(SINGLE), demonstration)
    return stream.getvalue()


def read_facts(group: Any) -> EpisodeFacts:
    """The facts of an episode.

    Raises:
        Exception: The group does not hold them; what h5py raises on damaged bytes has no end.
    """
    kinds = {part.name: part.type for part in fields(EpisodeFacts)}
    return EpisodeFacts(**{name: checked_value(name, group.attrs[name], _type(kind)) for name, kind in kinds.items()})


def read_observations(group: Any, names: Iterable[str], space: spaces.Dict) -> Observation:
    """Some of the arrays (T + 1, ...) that were observed.

    Raises:
        Exception: As `read_facts`.
    """
    rows = _steps(group) + 1
    return {name: _array(group["observations"][name], rows, space[name].shape, space[name].dtype) for name in names}


def read_actions(group: Any) -> npt.NDArray[np.float32]:
    """The actions (T, 9).

    Raises:
        Exception: As `read_facts`.
    """
    return _array(group["actions"], _steps(group), *_PLAIN["actions"])


def read_episode(group: Any, space: spaces.Dict) -> Demonstration:
    """A whole episode.

    Raises:
        Exception: As `read_facts`.
    """
    rows = _steps(group)
    plain = {name: _array(group[name], rows, *kind) for name, kind in _PLAIN.items()}
    giver_steps, giver_actions = _giver(group.attrs)
    return Demonstration(
        observations=read_observations(group, space.spaces, space),
        **plain,
        steps=_array(group["infos"]["steps"], rows + 1, (), np.int64),
        giver_steps=giver_steps,
        giver_actions=giver_actions,
        facts=read_facts(group),
    )


def _write(group: Any, demonstration: Demonstration) -> None:
    for name, array in demonstration.observations.items():
        _put(group, f"observations/{name}", array)
    for name in _PLAIN:
        _put(group, name, getattr(demonstration, name))
    _put(group, "infos/steps", demonstration.steps)
    told = asdict(demonstration.facts)
    # Minari numbers the episodes of a data set; alone, an episode is the first.
    told |= {"id": 0, "total_steps": len(demonstration), "options/scene_id": demonstration.facts.scene_id}
    if len(demonstration.giver_steps):
        told |= {name: getattr(demonstration, name) for name in _GIVER}
    for name, value in told.items():
        group.attrs[name] = value


def _put(group: Any, name: str, array: npt.NDArray[Any]) -> None:
    """Packed without loss and with checksums, so that damage shows."""
    row = max(1, array[:1].nbytes)
    chunks = (max(1, min(len(array), _CHUNK // row)), *array.shape[1:])
    group.create_dataset(name, data=array, chunks=chunks, compression="gzip", shuffle=True, fletcher32=True)


def _steps(group: Any) -> int:
    steps: int = checked_value("total_steps", group.attrs["total_steps"], int)
    if steps < 1:
        raise ValueError(f"an episode of {steps} decisions")
    return steps


def _array(data: Any, rows: int, shape: tuple[int, ...] | None, dtype: Any) -> npt.NDArray[Any]:
    """An array, looked at before it is unpacked."""
    wanted = (rows, *(shape or ()))
    if data.shape != wanted or data.dtype != np.dtype(dtype):
        raise ValueError(f"{data.name} is {data.dtype} {data.shape}, expected {np.dtype(dtype)} {wanted}")
    if data.size * data.dtype.itemsize > _LARGEST:
        raise ValueError(f"{data.name} has more than {_LARGEST // 1_000_000_000} GB")
    array: npt.NDArray[Any] = data[()]
    return array


def _giver(attributes: Mapping[str, Any]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    if _GIVER[0] not in attributes:
        return np.zeros(0, dtype=np.int64), np.zeros((0, GIVER_ACTION_SIZE), dtype=np.float32)
    steps, actions = (np.asarray(attributes[name]) for name in _GIVER)
    if steps.dtype != np.int64 or actions.dtype != np.float32 or actions.shape != (len(steps), GIVER_ACTION_SIZE):
        raise ValueError(f"giver_actions is {actions.dtype} {actions.shape} at {len(steps)} steps")
    return steps, actions


def _type(kind: Any) -> type:
    return int if kind in (int, "int") else str
