"""From grasps to goals: arm configurations at a grasp, each with the straight way to it from a standoff."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.arm import Arm, Frames, body_points
from handover_marl.models.poses import compose
from handover_marl.planning.inverse_kinematics import solve
from handover_marl.planning.obstacles import Obstacle
from handover_marl.planning.planner_config import PlannerConfig

Array = npt.NDArray[np.float64]
Limits = tuple[Array, Array]

_FINGERS = 2
_WRIST = 6
#: How many goals at the end of the list the original never checks; see `PlannerConfig.unchecked_last`.
UNCHECKED = 5


@dataclass(frozen=True, eq=False)
class GoalSet:
    """What the arm may end at.

    Attributes:
        tails: (g, t, 7) joints (rad) from the standoff to the grasp.
        grasps: (g,) which grasp each is.
        rooms: (g,) how far gripper and person's hand are apart in the tail (m); infinite where nobody looks.
    """

    tails: Array
    grasps: npt.NDArray[np.int_]
    rooms: Array

    def __len__(self) -> int:
        return len(self.tails)

    @property
    def standoffs(self) -> Array:
        """(g, 7) where the straight way begins."""
        return self.tails[:, 0]

    @property
    def goals(self) -> Array:
        """(g, 7) where it ends."""
        return self.tails[:, -1]

    def only(self, chosen: npt.NDArray[np.generic]) -> "GoalSet":
        """Some of the goals, by number or flag."""
        return GoalSet(self.tails[chosen], self.grasps[chosen], self.rooms[chosen])


class GoalFinder:
    """Makes goal sets.

    Args:
        arm: The arm.
        body: (m, 3) points on each of its links.
        gripper: (m, 3) points on its hand and fingers, to measure room with.
        start: (7,) where motions start.
        limits: Lowest and highest joints, padding included.
        config: How.
    """

    def __init__(
        self,
        arm: Arm,
        body: Sequence[Array],
        gripper: Sequence[Array],
        start: Array,
        limits: Limits,
        config: PlannerConfig,
    ) -> None:
        self._arm, self._body, self._gripper, self._start, self._limits = arm, body, gripper, start, limits
        self._config, self._hand, self._unchecked_last = config.goals, config.hand, config.unchecked_last

    def find(self, grasps: Array, objects: Sequence[Obstacle], person: Obstacle | None) -> GoalSet:
        """Goals for poses (n, 7) of the hand link at the grasps, in the base frame.

        Goals beside the person's hand come before those with less room; those with too little are left out while
        there are others.
        """
        found = self._with_flips(self._reached(grasps))
        found = found.only(self._turned_little(found.goals))
        found = found.only(self._clear(found.standoffs, objects))
        if person is not None and self._hand is not None and len(found):
            found = replace(found, rooms=self._rooms(found.tails, person))
            found = found.only(np.argsort(-found.rooms, kind="stable"))
            found = found.only(found.rooms >= min(self._hand.room, float(found.rooms.max())))
        return self._spread(found)

    def _rooms(self, tails: Array, person: Obstacle) -> Array:
        """(g,) smallest distance of the gripper to the person's hand over (g, t, 7) tails (m)."""
        frames = self._arm.frames(tails.reshape(-1, tails.shape[-1]))
        wrist = len(frames.origins) - len(self._gripper)
        points = body_points(Frames(frames.origins[wrist:], frames.rotations[wrist:]), self._gripper)
        distances = person.distances(points.reshape(3, -1).astype(np.float32))
        rooms: Array = distances.reshape(points.shape[1], *tails.shape[:2]).min(axis=(0, 2)).astype(np.float64)
        return rooms

    def _reached(self, grasps: Array) -> GoalSet:
        """Straight tails from every seed to every grasp, where inverse kinematics finds them."""
        config = self._config
        seeds = np.array([self._start, *config.anchors])
        numbers = np.repeat(np.arange(len(grasps)), len(seeds))
        joints, solved = self._solve(self._tail_poses(grasps, 0), numbers, np.tile(seeds, (len(grasps), 1)))
        numbers, rows = numbers[solved], [joints[solved]]
        # The grasp first, from the standoff; then back out, each pose from the one before it.
        for step in (config.tail - 1, *range(config.tail - 2, -1, -1)):
            joints, solved = self._solve(self._tail_poses(grasps, step), numbers, rows[-1])
            numbers, rows = numbers[solved], [*(row[solved] for row in rows), joints[solved]]
        tails = np.stack([rows[-1], *rows[-2:0:-1]], axis=1) if len(numbers) else np.zeros((0, config.tail, 7))
        short = np.linalg.norm(np.diff(tails, axis=1), axis=(1, 2)) < config.longest_tail
        return GoalSet(tails[short], numbers[short], np.full(int(short.sum()), np.inf))

    def _tail_poses(self, grasps: Array, step: int) -> Array:
        back = self._config.standoff / self._config.tail * (self._config.tail - 1 - step)
        return compose(grasps, np.array([0.0, 0.0, -back, 0.0, 0.0, 0.0, 1.0]))

    def _solve(self, poses: Array, numbers: npt.NDArray[np.int_], seeds: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
        config = self._config
        return solve(
            self._arm,
            poses[numbers, :3],
            rotations[numbers],
            seeds,
            self._limits,
            config.tolerance,
            config.iterations,
        )

    def _with_flips(self, found: GoalSet) -> GoalSet:
        """Adds the same grasps with the wrist turned by half a turn, where its limits allow."""
        flipped = found.tails.copy()
        # All rows the way of the first, so that a tail across zero is not torn apart.
        flipped[..., _WRIST] -= np.copysign(np.pi, found.tails[:, :1, _WRIST])
        low, high = self._limits[0][_WRIST], self._limits[1][_WRIST]
        fits = ((low < flipped[..., _WRIST]) & (flipped[..., _WRIST] < high)).all(axis=1)
        copies = replace(found, tails=flipped).only(fits)
        return GoalSet(
            np.concatenate([found.tails, copies.tails]),
            np.concatenate([found.grasps, copies.grasps]),
            np.concatenate([found.rooms, copies.rooms]),
        )

    def _turned_little(self, goals: Array) -> npt.NDArray[np.bool_]:
        """Whether the hand stays upright enough on the straight joint line from the start."""
        config = self._config
        shares = np.arange(1, config.way_points + 1) / (config.way_points + 1)
        line = self._start + shares[:, None, None] * (goals - self._start)
        turned = self._arm.chain(line.reshape(-1, 7)).rotations[-1]
        first = self._arm.chain(self._start[None]).rotations[-1][..., 0]
        cosine = (np.einsum("ij,ijn->n", first, turned) - 1.0) / 2.0
        fine = (cosine >= np.cos(config.largest_turn)) & (turned[2, 0] >= config.lowest_x)
        upright: npt.NDArray[np.bool_] = fine.reshape(len(shares), -1).all(axis=0)
        return upright

    def _clear(self, standoffs: Array, obstacles: Sequence[Obstacle]) -> npt.NDArray[np.bool_]:
        """Whether arm and hand, fingers not counted, keep clear of the objects at the standoff."""
        points = body_points(self._arm.frames(standoffs), self._body)
        per_link = len(self._body[0])
        points = points[:, : points.shape[1] - _FINGERS * per_link]
        hits = np.zeros(len(standoffs), dtype=np.int_)
        for obstacle in obstacles:
            distances = obstacle.distances(points.reshape(3, -1).astype(np.float32))
            hits += (distances.reshape(points.shape[1:]) < self._config.clearance).sum(axis=0)
        clear: npt.NDArray[np.bool_] = hits <= self._config.allowed_points
        if self._unchecked_last:
            clear[-UNCHECKED:] = True
        return clear

    def _spread(self, found: GoalSet) -> GoalSet:
        """The first of every bunch of goals with much the same standoff, and at most so many, drawn evenly."""
        kept: list[int] = []
        for number, standoff in enumerate(found.standoffs):
            away = np.linalg.norm(found.standoffs[kept] - standoff, axis=1)
            if (away >= self._config.diversity).all():
                kept.append(number)
        order = np.random.default_rng(0).permutation(len(kept))[: self._config.most]
        return found.only(np.array(kept, dtype=np.int_)[order])
