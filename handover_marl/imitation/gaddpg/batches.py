"""Batches of stored states as tensors, seen from a little beside where they were seen."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from handover_marl.imitation.gaddpg.states import States
from handover_marl.models.poses import compose, inverse
from handover_marl.planning.approach import ApproachConfig, steps_to_goals

_HERE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True)
class BatchConfig:
    """How states are varied.

    Attributes:
        shift: Standard deviation of a displacement of the hand along each axis (m), and
        turn: of a turn about each (rad). The cloud stays what was seen from where the hand was.
        early: The counter is moved by this many decisions at most, and the expert's step with it.
        most: Of the counter.
        neighbours: So many points of a group are looked at, which are those that were drawn first.
    """

    shift: float = 0.012
    turn: float = 0.05
    early: int = 6
    most: int = 20
    neighbours: int = 32


@dataclass(frozen=True, eq=False)
class Batch:
    """B states; groups of points one behind the other.

    Attributes:
        points: (P, 3) all points in the hands' frames (m).
        centers: (C,) points that groups are round.
        near: (N,) points of the groups.
        n_near: (C,) how many each has.
        beside: (M,) centers of the groups of groups.
        n_beside: (C,) how many each has.
        n_centers: (B,) groups of each state.
        remaining: (B,) decisions left.
        steps: (B, 6) what the expert does: translation (m) and Euler angles (rad).
        goals: (B, 7) where the grasp is: xyz (m) and quaternion xyzw.
    """

    points: Tensor
    centers: Tensor
    near: Tensor
    n_near: Tensor
    beside: Tensor
    n_beside: Tensor
    n_centers: Tensor
    remaining: Tensor
    steps: Tensor
    goals: Tensor

    def to(self, device: torch.device) -> "Batch":
        """The same on a device."""
        return Batch(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


class Batches:
    """Makes batches of states.

    Args:
        states: They.
        approach: What the expert does.
        config: How states are varied.
    """

    def __init__(self, states: States, approach: ApproachConfig, config: BatchConfig) -> None:
        self._states, self._approach, self._config = states, approach, config
        firsts = np.concatenate([[0], np.cumsum(states.n_centers)])
        self._points, self._centers = np.concatenate([[0], np.cumsum(states.n_points)]), firsts
        self._near = np.concatenate([[0], np.cumsum(states.n_near)])[firsts]
        self._beside = np.concatenate([[0], np.cumsum(states.n_beside)])[firsts]

    def batch(self, numbers: npt.NDArray[np.int_], rng: np.random.Generator | None) -> Batch:
        """A batch of some states, varied if something to draw with is given."""
        states = self._states
        sizes, groups = states.n_points[numbers], states.n_centers[numbers]
        first_point = np.cumsum(sizes) - sizes
        first_center = np.cumsum(groups) - groups
        remaining = states.remaining[numbers].astype(np.float32)
        hands = np.tile(_HERE, (len(numbers), 1))
        if rng is not None:
            hands, remaining = self._varied(remaining, rng)
        goals = compose(inverse(hands), states.goals[numbers].astype(np.float64))
        points = self._taken(states.points, self._points, numbers).astype(np.float32)
        centers = self._taken(states.centers, self._centers, numbers) + np.repeat(first_point, groups)
        n_near = self._taken(states.n_near, self._centers, numbers)
        n_beside = self._taken(states.n_beside, self._centers, numbers)
        near = self._taken(states.near, self._near, numbers)
        near, n_near = _first(near, n_near, self._config.neighbours)
        beside = self._taken(states.beside, self._beside, numbers)
        return Batch(
            points=torch.from_numpy(_seen_from(hands, points, sizes)),
            centers=torch.from_numpy(centers),
            near=torch.from_numpy(near + np.repeat(np.repeat(first_point, groups), n_near)),
            n_near=torch.from_numpy(n_near.astype(np.int64)),
            beside=torch.from_numpy(beside + np.repeat(np.repeat(first_center, groups), n_beside)),
            n_beside=torch.from_numpy(n_beside.astype(np.int64)),
            n_centers=torch.from_numpy(groups.astype(np.int64)),
            remaining=torch.from_numpy(remaining),
            steps=torch.from_numpy(self._steps(goals, remaining)),
            goals=torch.from_numpy(goals.astype(np.float32)),
        )

    def _steps(self, goals: npt.NDArray[np.float64], remaining: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        here = np.tile(_HERE, (len(goals), 1))
        return steps_to_goals(here, goals, remaining.astype(np.float64), self._approach).astype(np.float32)

    def _varied(
        self, remaining: npt.NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
        """Where the hands are instead, (B, 7), and what the counter tells."""
        config, count = self._config, len(remaining)
        turns = Rotation.from_rotvec(rng.normal(0.0, config.turn, (count, 3))).as_quat()
        hands = np.concatenate([rng.normal(0.0, config.shift, (count, 3)), turns], axis=1)
        told = remaining + rng.integers(-config.early, config.early + 1, count)
        return hands, np.clip(told, 1, config.most).astype(np.float32)

    @staticmethod
    def _taken(
        values: npt.NDArray[np.generic], firsts: npt.NDArray[np.int_], numbers: npt.NDArray[np.int_]
    ) -> npt.NDArray[np.int64]:
        parts = [values[firsts[number] : firsts[number + 1]] for number in numbers]
        taken: npt.NDArray[np.int64] = np.concatenate(parts)
        return taken if taken.dtype == np.float16 else taken.astype(np.int64)


def _first(
    values: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], most: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """At most so many of each group."""
    places = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
    return values[places < most], np.minimum(counts, most)


def _seen_from(
    hands: npt.NDArray[np.float64], points: npt.NDArray[np.float32], sizes: npt.NDArray[np.int32]
) -> npt.NDArray[np.float32]:
    """Points (P, 3), so many of each state, in the frames of poses (B, 7)."""
    turns = np.repeat(Rotation.from_quat(hands[:, 3:]).as_matrix(), sizes, axis=0).astype(np.float32)
    away = points - np.repeat(hands[:, :3], sizes, axis=0).astype(np.float32)
    found: npt.NDArray[np.float32] = np.einsum("pi,pij->pj", away, turns)
    return found
