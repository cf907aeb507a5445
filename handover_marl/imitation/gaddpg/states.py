"""What a network is trained on: what the receiver sees at a decision, and where the grasp is.

PointNet++ looks at groups of points. Which ones follows from the points alone and not from where the hand is, so that
they are found once for a stored cloud and not at every look, also when it is looked at from a little beside. Repeats
of points do not change what it says, so that neither repeats nor the empty places of groups are stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import ResultsError
from handover_marl.files import write_arrays
from handover_marl.networks.point_encoders import Grouping
from handover_marl.networks.point_sampling import PADDING

#: The two groupings of GA-DDPG's encoder.
FIRST, SECOND = Grouping(32, 0.02, 64), Grouping(32, 0.04, 128)


@dataclass(frozen=True, eq=False)
class States:
    """Many of them, one behind the other.

    Attributes:
        points: (P, 3) float16 distinct points in the hand link's frame, in the network's order (m).
        n_points: (S,) how many each state has.
        centers: (C,) points, counted within their state, that groups are round.
        n_centers: (S,) how many each state has.
        near: (N,) points of the groups, counted likewise.
        n_near: (C,) how many each group has.
        beside: (M,) groups of groups: centers, counted within their state.
        n_beside: (C,) how many each has.
        goals: (S, 7) float32 poses of the hand at the grasp, in the present hand link's frame.
        remaining: (S,) decisions left.
    """

    points: npt.NDArray[np.float16]
    n_points: npt.NDArray[np.int32]
    centers: npt.NDArray[np.int16]
    n_centers: npt.NDArray[np.int32]
    near: npt.NDArray[np.int16]
    n_near: npt.NDArray[np.int32]
    beside: npt.NDArray[np.int16]
    n_beside: npt.NDArray[np.int32]
    goals: npt.NDArray[np.float32]
    remaining: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.remaining)


def state(points: npt.NDArray[np.floating], goal: npt.NDArray[np.floating], remaining: int) -> States:
    """One state.

    Args:
        points: (n, 3) distinct points in the hand link's frame, n at least 1, in the network's order (m).
        goal: (7,) pose of the hand at the grasp in the same frame.
        remaining: Decisions left.
    """
    kept = points.astype(np.float16)
    places = kept.astype(np.float32)
    centers = _farthest(places, FIRST.centers)
    first = _near(places[centers], places, FIRST)
    second = _near(places[centers], places[centers], SECOND)
    return States(
        points=kept,
        n_points=np.array([len(kept)], dtype=np.int32),
        centers=centers.astype(np.int16),
        n_centers=np.array([len(centers)], dtype=np.int32),
        near=first[0],
        n_near=first[1],
        beside=second[0],
        n_beside=second[1],
        goals=goal[None].astype(np.float32),
        remaining=np.array([remaining], dtype=np.int32),
    )


def joined(parts: Sequence[States]) -> States:
    """All of them together."""
    if not parts:
        return _NOTHING
    return States(*(np.concatenate([getattr(part, name) for part in parts]) for name in _NAMES))


def write_states(path: Path, states: States) -> None:
    """Write a file of states.

    Raises:
        ResultsError: It cannot be written.
    """
    write_arrays(path, {name: getattr(states, name) for name in _NAMES})


def read_states(path: Path) -> States:
    """Read what `write_states` wrote.

    Raises:
        ResultsError: It is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            found = States(*(content[name] for name in _NAMES))
            if int(found.n_points.sum()) != len(found.points) or len(found.goals) != len(found):
                raise ValueError("parts that do not fit together")
            return found
    except Exception as error:  # what NumPy and zipfile raise on damaged bytes has no end
        raise ResultsError(f"{path}: no states of this run ({type(error).__name__}); remove it to go on") from error


def _farthest(places: npt.NDArray[np.float32], count: int) -> npt.NDArray[np.int_]:
    """Distinct points that `farthest_points` finds; it repeats some where there are fewer."""
    padding = (places**2).sum(axis=1) <= PADDING
    distances = np.full(len(places), 1e10, dtype=np.float32)
    chosen = [0]
    for _ in range(1, min(count, len(places))):
        distances = np.minimum(distances, ((places - places[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(np.argmax(np.where(padding, np.float32(-1.0), distances))))
    return np.array(list(dict.fromkeys(chosen)))


def _near(
    centers: npt.NDArray[np.float32], places: npt.NDArray[np.float32], grouping: Grouping
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int32]]:
    """The points near each center, and how many, as `ball_neighbours` finds them, without repeats."""
    away = ((centers[:, None] - places[None]) ** 2).sum(axis=-1)
    near = away < np.float32(grouping.radius) ** 2
    near &= near.cumsum(axis=1) <= grouping.neighbours
    return np.nonzero(near)[1].astype(np.int16), near.sum(axis=1).astype(np.int32)


_NAMES: tuple[str, ...] = tuple(part.name for part in fields(States))
_KINDS: dict[str, Any] = {"points": np.float16, "goals": np.float32, "centers": np.int16, "near": np.int16}
_KINDS |= {"beside": np.int16}
_WIDE = {"points": (0, 3), "goals": (0, 7)}
_NOTHING = States(*(np.zeros(_WIDE.get(name, (0,)), dtype=_KINDS.get(name, np.int32)) for name in _NAMES))
