"""Imitation states: the receiver's point cloud at a decision, and the grasp to approach."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.learning.imitation.samples import stack_samples

# Number of points of a stored cloud: that of the network's input.
_N_POINTS = 1024


class ImitationStates(NamedTuple):
    """Arrays of S imitation states.

    Repeated points do not change the network's output and are not stored.

    Attributes:
        points: (S, 1024, 3) distinct points in the hand link's frame, in the network's order, then zeros (m).
        n_points: (S,) numbers of distinct points.
        goals: (S, 7) poses of the hand link at the grasp, in the present frame of the hand link.
        remaining: (S,) numbers of decisions that remain in the approach.
    """

    points: npt.NDArray[np.float16]
    n_points: npt.NDArray[np.int32]
    goals: npt.NDArray[np.float32]
    remaining: npt.NDArray[np.int32]


#: Values of one state: points (n, 3), goal (7,) and the number of remaining decisions.
StateRow = tuple[npt.NDArray[np.floating], npt.NDArray[np.floating], int]


def stack_states(rows: list[StateRow]) -> ImitationStates:
    """Return the imitation states with given values."""
    columns: list[tuple[npt.DTypeLike, tuple[int, ...]]]
    columns = [(np.float16, (_N_POINTS, 3)), (np.int32, ()), (np.float32, (7,)), (np.int32, ())]
    padded: list[tuple[Any, ...]] = [
        (np.pad(points, ((0, _N_POINTS - len(points)), (0, 0))), len(points), goal, remaining)
        for points, goal, remaining in rows
    ]
    return stack_samples(ImitationStates, padded, columns)
