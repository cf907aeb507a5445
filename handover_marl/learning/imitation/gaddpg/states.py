"""Imitation states: the receiver's point cloud at a decision, and the grasp to approach.

PointNet++ groups points around sampled centers. The groups depend on the points only, not on the
pose of the hand. They are therefore computed once per state, even if the state is augmented later.
Repeated points do not change the network's output and are not stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import ResultsError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.reading import read_arrays
from handover_marl.learning.networks.point_encoders import GADDPG_GROUPINGS, PADDING_SQUARED_NORM, BallGrouping

#: Largest accepted size of a file of states or plans (bytes, unpacked).
MAX_STATES_BYTES = 8_000_000_000


@dataclass(frozen=True, eq=False)
class ImitationStates:
    """Imitation states: arrays of S states, concatenated.

    Attributes:
        points: (P, 3) float16 distinct points in the hand link's frame, in the network's order (m).
        n_points: (S,) numbers of points of the states.
        centers: (C,) indices of the centers of groups, among the state's points.
        n_centers: (S,) numbers of centers of the states.
        neighbors: (N,) indices of the points of the groups, among the state's points.
        n_neighbors: (C,) numbers of points of the groups.
        center_neighbors: (M,) indices of the centers in groups of groups, among the state's centers.
        n_center_neighbors: (C,) numbers of centers of the groups of groups.
        goals: (S, 7) float32 poses of the hand link at the grasp, in the present frame of the hand link.
        remaining: (S,) numbers of decisions that remain in the approach.
    """

    points: npt.NDArray[np.float16]
    n_points: npt.NDArray[np.int32]
    centers: npt.NDArray[np.int16]
    n_centers: npt.NDArray[np.int32]
    neighbors: npt.NDArray[np.int16]
    n_neighbors: npt.NDArray[np.int32]
    center_neighbors: npt.NDArray[np.int16]
    n_center_neighbors: npt.NDArray[np.int32]
    goals: npt.NDArray[np.float32]
    remaining: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.remaining)


_NAMES = tuple(part.name for part in fields(ImitationStates))


def make_state(points: npt.NDArray[np.floating], goal: npt.NDArray[np.floating], remaining: int) -> ImitationStates:
    """Create a single imitation state from a point cloud and the grasp to approach.

    Args:
        points: (n, 3) distinct points in the hand link's frame, in the network's order, n > 0 (m).
        goal: (7,) pose of the hand link at the grasp in the same frame, quaternion xyzw.
        remaining: Number of decisions that remain in the approach.
    """
    rounded = points.astype(np.float16)
    positions = rounded.astype(np.float32)
    centers = _sample_farthest_points(positions, GADDPG_GROUPINGS[0].centers)
    neighbors, n_neighbors = _query_ball(positions[centers], positions, GADDPG_GROUPINGS[0])
    center_neighbors, n_center_neighbors = _query_ball(positions[centers], positions[centers], GADDPG_GROUPINGS[1])
    return ImitationStates(
        points=rounded,
        n_points=np.array([len(rounded)], dtype=np.int32),
        centers=centers.astype(np.int16),
        n_centers=np.array([len(centers)], dtype=np.int32),
        neighbors=neighbors,
        n_neighbors=n_neighbors,
        center_neighbors=center_neighbors,
        n_center_neighbors=n_center_neighbors,
        goals=goal[None].astype(np.float32),
        remaining=np.array([remaining], dtype=np.int32),
    )


def concatenate_states(parts: Sequence[ImitationStates]) -> ImitationStates:
    """Return the imitation states of several parts, concatenated in their order."""
    if not parts:
        # Types and shapes of the arrays follow from any state.
        example = make_state(np.zeros((1, 3)), np.zeros(7), 0)
        return ImitationStates(*(getattr(example, name)[:0] for name in _NAMES))
    return ImitationStates(*(np.concatenate([getattr(part, name) for part in parts]) for name in _NAMES))


def write_states(path: Path, states: ImitationStates) -> None:
    """Write imitation states to a file.

    Raises:
        ResultsError: The file cannot be written.
    """
    write_arrays(path, {name: getattr(states, name) for name in _NAMES})


def read_states(path: Path) -> ImitationStates:
    """Read imitation states from a file.

    Raises:
        ResultsError: The file is damaged.
    """
    try:
        arrays = read_arrays(path, largest=MAX_STATES_BYTES)
        states = ImitationStates(*(arrays[name] for name in _NAMES))
        if int(states.n_points.sum()) != len(states.points) or len(states.goals) != len(states):
            raise ValueError("arrays of different lengths")
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise ResultsError(f"{path}: not a file of states ({shorten_text(error)}); remove it and resume") from error
    return states


def _sample_farthest_points(positions: npt.NDArray[np.float32], count: int) -> npt.NDArray[np.int_]:
    """Return the distinct points of `handover_marl.learning.networks.point_encoders.sample_farthest_points`."""
    padding = (positions**2).sum(axis=1) <= PADDING_SQUARED_NORM
    distances = np.full(len(positions), 1e10, dtype=np.float32)
    chosen = [0]
    for _ in range(1, min(count, len(positions))):
        distances = np.minimum(distances, ((positions - positions[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(np.argmax(np.where(padding, np.float32(-1.0), distances))))
    return np.array(list(dict.fromkeys(chosen)))


def _query_ball(
    centers: npt.NDArray[np.float32], positions: npt.NDArray[np.float32], grouping: BallGrouping
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int32]]:
    """Return the distinct points of `handover_marl.learning.networks.point_encoders.query_ball`, and their numbers."""
    squared = ((centers[:, None] - positions[None]) ** 2).sum(axis=-1)
    near = squared < np.float32(grouping.radius) ** 2
    near &= near.cumsum(axis=1) <= grouping.neighbors
    return np.nonzero(near)[1].astype(np.int16), near.sum(axis=1).astype(np.int32)
