"""Motion of givers: reference motion of hands and objects, from the recordings and the givers' actions."""

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, TIME_STEP, GiverConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.episode.wrist_offset import apply_wrist_offsets, delay_steps, track_set_points
from handover_marl.geometry.arrays import AnyArray, AnyIntegers, Indices, get_namespace, make_constant
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.simulation.reference_tracking import BASE_JOINTS, WRIST_LINK, ReferenceMotion

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]

#: Number of physics steps for which the giver's motion is planned at a time.
PLANNED_STEPS = 200
#: Pick-up frame of objects that are never picked up.
NEVER = np.iinfo(np.int64).max
#: Action of the giver that replays the recording.
NO_DEVIATION = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)
NO_DEVIATION.flags.writeable = False
_BASE_LINK = 5


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """Planned motion of r givers in k physics steps.

    Attributes:
        rows: Indices (r,) of the givers.
        references: Reference motion of each giver.
        clocks: Playback times (r, k) after each step (frames).
        frames: Frames (r, k) of the recordings.
        rates: Playback rates minus 1 (r, k).
        moving: Indices (d,) in `rows` of the givers with an offset of the wrist.
        offsets: Displacements (m) and rotation vectors (rad) of the wrists, (k, d, 2, 3).
        velocities: Their velocities (k, d, 2, 3).
        opening_progress: Progress of the hands' opening (r, k), 0 to 1.
    """

    rows: Indices
    references: list[ReferenceMotion]
    clocks: Array
    frames: Indices
    rates: Array
    moving: Indices
    offsets: Array
    velocities: Array
    opening_progress: Array


class GiverMotion:
    """Playback of one recorded scene for each of n givers, with their deviations; it stays at the last frame.

    `plan` returns the motion of the next physics steps, `commit` applies as many of them as were simulated. Hand and
    held object deviate together, rigidly about the wrist, and only after the object has been picked up, because until
    then the hand must reach it. The motion of a giver does not depend on the others.

    Args:
        count: Number n of givers.
        config: Limits of the deviation from the recordings.

    Attributes:
        frame: Current frame (n,) of each recording.
        rate: Playback rates minus 1 (n,).
        offset: Wrist displacement (m) and rotation vector (rad) of each giver, (n, 2, 3).
        opening_progress: Progress (n,) of each hand's opening, 0 to 1.
    """

    def __init__(self, count: int, config: GiverConfig) -> None:
        self._config = config
        self._scenes: list[Scene | None] = [None] * count
        self._hand_present: list[Flags] = [np.zeros(0, dtype=bool)] * count
        self._wrists_in_base = np.zeros((count, 3))
        self._last_frame, self._pick_up = np.zeros(count, dtype=np.int_), np.full(count, NEVER)
        self._clock, self.frame, self.rate = np.zeros(count), np.zeros(count, dtype=np.int_), np.zeros(count)
        self.offset, self._velocity = np.zeros((count, 2, 3)), np.zeros((count, 2, 3))
        self._has_deviated, self.opening_progress = np.zeros(count, dtype=bool), np.zeros(count)
        # Last reference of hand base and object; their Euler angles continue from it without a jump.
        self._last = np.zeros((count, 2, OBJECT_DOF), dtype=np.float32)

    def reset(self, row: int, scene: Scene) -> ReferenceMotion:
        """Start to play a scene, and return its first frame as a reference motion of one row.

        Args:
            row: Index of the giver.
            scene: Scene to play.
        """
        self._scenes[row] = scene
        self._hand_present[row] = scene.is_hand_present(np.arange(scene.n_frames))
        self._wrists_in_base[row] = find_wrist_in_base(scene)
        pick_up = find_pick_up_frame(scene)
        self._last_frame[row], self._pick_up[row] = scene.n_frames - 1, NEVER if pick_up is None else pick_up
        self._has_deviated[row] = False
        for state in (self._clock, self.frame, self.rate, self.offset, self._velocity, self.opening_progress):
            state[row] = 0
        self._last[row] = scene.hand_dof[0, :BASE_JOINTS], scene.object_dof[0, 0]
        return self._read_frames(row, np.array([0]))

    @property
    def holding(self) -> Flags:
        """Mask (n,) of the persons who have picked up the object, so that displacements take effect."""
        return np.asarray(self.frame >= self._pick_up)

    @property
    def deviation(self) -> Float32:
        """(n, 7) playback rates minus 1, wrist displacements (m) and rotation vectors (rad)."""
        return np.concatenate([self.rate[:, None], self.offset.reshape(-1, 6)], axis=1).astype(np.float32)

    def plan(self, rows: Indices, steps: int, actions: Float32, released: Flags, is_opening: Flags) -> PlannedMotion:
        """Return the motion of r givers in the next physics steps, without advancing the playback.

        Args:
            rows: Indices (r,) of the givers.
            steps: Number of physics steps k.
            actions: (r, 8) actions.
            released: Whether each object has been released, so that it does not follow the hand, (r,).
            is_opening: Whether each hand opens after a voluntary release, (r,).
        """
        rates = ramp_rates(self.rate[rows], actions[:, 0].astype(np.float64), self._config.rate_change, steps)
        clocks = self._clock[rows, None] + np.cumsum(1.0 + rates, axis=1)
        # Rates often sum to halves; rounding to 9 digits first keeps float noise from deciding.
        frames = np.minimum(np.rint(np.round(clocks, 9)), self._last_frame[rows, None]).astype(np.int_)
        references = [self._read_frames(row, own) for row, own in zip(rows.tolist(), frames, strict=True)]
        # An object that is picked up during these steps must not move early. Before, the offset is zero and at rest.
        delays = count_steps_until_pick_up(self._pick_up[rows], self.frame[rows], frames)
        set_points = np.where(delays[:, None] < steps, actions[:, 1:7].astype(np.float64), 0.0).reshape(-1, 2, 3)
        moving = np.flatnonzero(self._has_deviated[rows] | set_points.any(axis=(1, 2)))
        offsets, velocities = np.zeros((steps, 0, 2, 3)), np.zeros((steps, 0, 2, 3))
        if len(moving):
            who, config = rows[moving], self._config
            limits = np.array([[config.speed, config.turn_speed], [config.acceleration, config.turn_acceleration]])
            track = track_set_points(self.offset[who], self._velocity[who], set_points[moving], steps, limits)
            offsets, velocities = (delay_steps(part, delays[moving]) for part in track)
            self._apply_offsets(who, moving, references, offsets, released[moving])
        progress = np.repeat(self.opening_progress[rows, None], steps, axis=1)
        if is_opening.any():
            self._open_hands(is_opening, references, progress)
        return PlannedMotion(rows, references, clocks, frames, rates, moving, offsets, velocities, progress)

    def commit(self, motion: PlannedMotion, steps: AnyIntegers) -> None:
        """Advance the playback by the planned steps that were simulated.

        Args:
            motion: Motion as returned by `plan`.
            steps: Number of simulated steps (r,) of each giver.
        """
        simulated = np.flatnonzero(steps)
        rows, last = motion.rows[simulated], steps[simulated] - 1
        self._clock[rows], self.frame[rows] = motion.clocks[simulated, last], motion.frames[simulated, last]
        self.rate[rows] = motion.rates[simulated, last]
        self.opening_progress[rows] = motion.opening_progress[simulated, last]
        for index, step in zip(simulated.tolist(), last.tolist(), strict=True):
            reference, row = motion.references[index], motion.rows[index]
            self._last[row] = reference.hand[step, :BASE_JOINTS], reference.objects[step, 0]
        moved = steps[motion.moving] > 0
        index, who = np.flatnonzero(moved), motion.rows[motion.moving[moved]]
        last = steps[motion.moving[moved]] - 1
        self.offset[who], self._velocity[who] = motion.offsets[last, index], motion.velocities[last, index]
        self._has_deviated[who] = True

    def _apply_offsets(
        self, who: Indices, moving: Indices, references: list[ReferenceMotion], offsets: Array, released: Flags
    ) -> None:
        """Move hands and held objects with their wrists' offsets, in the reference motions.

        Args:
            who: Numbers (d,) of the givers.
            moving: Indices (d,) in `references` of the motions that change.
            references: Reference motions.
            offsets: Offsets (k, d, 2, 3) of the wrists.
            released: Whether each object has been released, (d,).
        """
        recorded = [references[index] for index in moving.tolist()]
        bodies = [np.stack([motion.hand[:, :BASE_JOINTS], motion.objects[:, 0]]) for motion in recorded]
        # At rest, rows are equal from some row on: compute the first of them.
        counts = [
            _count_distinct_rows(offsets[:, number].reshape(len(offsets), 6), *both)
            for number, both in enumerate(bodies)
        ]
        moved = apply_wrist_offsets(
            [both[:, :count] for both, count in zip(bodies, counts, strict=True)],
            self._wrists_in_base[who],
            [offsets[:count, number] for number, count in enumerate(counts)],
            self._last[who],
        )
        for number, index in enumerate(moving.tolist()):
            before, count = recorded[number], counts[number]
            hand = before.hand.copy()
            hand[:count, :BASE_JOINTS], hand[count:, :BASE_JOINTS] = moved[number][0], moved[number][0, -1]
            objects = before.objects
            if not released[number]:
                objects = objects.copy()
                objects[:count, 0], objects[count:, 0] = moved[number][1], moved[number][1, -1]
            references[index] = ReferenceMotion(objects, hand, before.hand_present)

    def _open_hands(self, is_opening: Flags, references: list[ReferenceMotion], progress: Array) -> None:
        """Move the finger angles of opening hands towards zero, which is a flat hand in MANO."""
        steps = progress.shape[1]
        pace = TIME_STEP / self._config.opening_time
        progress[is_opening] = np.minimum(progress[is_opening] + pace * np.arange(1, steps + 1), 1.0)
        for index in np.flatnonzero(is_opening).tolist():
            before = references[index]
            hand = before.hand.copy()
            hand[:, BASE_JOINTS:] *= (1.0 - self._config.opening * progress[index, :, None]).astype(np.float32)
            references[index] = ReferenceMotion(before.objects, hand, before.hand_present)

    def _read_frames(self, row: int, frames: Indices) -> ReferenceMotion:
        scene, first, last = self._scenes[row], int(frames[0]), int(frames[-1])
        if scene is None:
            raise ValueError(f"giver {row} has no scene; call reset() first")
        # A slice needs no copy. At the recording's end, and at other speeds, frames are not consecutive.
        is_consecutive = last - first == len(frames) - 1 and bool((np.diff(frames) == 1).all())
        part = slice(first, last + 1) if is_consecutive else frames
        return ReferenceMotion(scene.object_dof[part], scene.hand_dof[part], self._hand_present[row][part])


def count_steps_until_pick_up(pick_up: AnyArray, now: AnyArray, frames: AnyArray) -> AnyArray:
    """Return the number (r,) of the next k steps that start before each object is picked up.

    Args:
        pick_up: Frames (r,) in which the objects are picked up.
        now: Current frames (r,).
        frames: Frames (r, k) after each step.
    """
    xp = get_namespace(frames)
    return xp.sum(xp.concat([now[:, None], frames[:, :-1]], axis=1) < pick_up[:, None], axis=1)


def ramp_rates(rates: AnyArray, targets: AnyArray, max_slope: float, steps: int) -> AnyArray:
    """Return playback rates minus 1 (r, k) after each of k steps that approach targets with limited slope.

    Args:
        rates: Current rates minus 1 (r,).
        targets: Rates minus 1 (r,) to reach.
        max_slope: Largest change of a rate (1/s).
        steps: Number k of physics steps.
    """
    xp, change = get_namespace(rates), (targets - rates)[:, None]
    limits = make_constant(tuple(range(1, steps + 1)), rates) * (max_slope * TIME_STEP)
    limited = xp.minimum(xp.maximum(change, -limits), limits)
    return xp.where(xp.abs(limited) < xp.abs(change), rates[:, None] + limited, targets[:, None])


def _count_distinct_rows(*arrays: npt.NDArray[np.floating]) -> int:
    """Return the number of rows up to the last one that differs from the row before it in any array."""
    differs = np.zeros(len(arrays[0]), dtype=bool)
    for array in arrays:
        differs[1:] |= (array[1:] != array[:-1]).any(axis=1)
    return int(np.flatnonzero(differs)[-1]) + 1 if differs.any() else 1


def find_wrist_in_base(scene: Scene) -> npt.NDArray[np.float64]:
    """Return the (3,) position of the human wrist in the frame of the hand's base (m)."""
    wrist_in_base: npt.NDArray[np.float64] = _compute_wrist_in_base(read_tree(scene.assets.hand)).copy()
    return wrist_in_base


@functools.lru_cache(maxsize=64)
def _compute_wrist_in_base(tree: KinematicTree) -> npt.NDArray[np.float64]:
    origins, _ = tree.compute_link_frames(np.zeros((1, tree.n_dof)))
    wrist_in_base: npt.NDArray[np.float64] = origins[0, WRIST_LINK] - origins[0, _BASE_LINK]
    return wrist_in_base


def find_pick_up_frame(scene: Scene, distance: float = 0.005) -> int | None:
    """Return the first frame with the object farther than `distance` (m) from its start.

    None if the object stays near its start.
    """
    moved = np.linalg.norm(scene.object_dof[:, 0, :3] - scene.object_dof[0, 0, :3], axis=1) > distance
    return int(np.argmax(moved)) if moved.any() else None
