"""Motion of the giver: reference motion of hand and objects, from the recording and the giver's actions."""

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, GiverConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, GiverAction
from handover_marl.episode.wrist_offset import TrackedVector, apply_wrist_offset, track_set_point
from handover_marl.geometry.arrays import Indices
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.simulation.reference_tracking import BASE_JOINTS, WRIST_LINK, ReferenceMotion

#: Number of physics steps for which the giver's motion is planned at a time.
PLANNED_STEPS = 200
_BASE_LINK = 5
#: Action of the giver that replays the recording.
NO_DEVIATION = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)
NO_DEVIATION.flags.writeable = False


class _PlaybackState(NamedTuple):
    """State of the playback of a recording after a physics step.

    Attributes:
        motion: Last reference motion; Euler angles continue from its last row without a jump.
        clock: Playback time in frames.
        frame: Current frame of the recording.
        rate: Playback rate minus 1.
        displacement: Displacement of the wrist (m).
        rotation: Rotation vector of the wrist (rad).
        has_deviated: Whether the wrist has ever been displaced or rotated.
        opening_progress: Progress of the hand's opening, 0 to 1.
    """

    motion: ReferenceMotion
    clock: float = 0.0
    frame: int = 0
    rate: float = 0.0
    displacement: TrackedVector = TrackedVector()
    rotation: TrackedVector = TrackedVector()
    has_deviated: bool = False
    opening_progress: float = 0.0


class _Command(NamedTuple):
    """Set-points of the giver for some physics steps.

    Attributes:
        rate: Playback rate minus 1.
        displacement: (3,) set-point of the wrist's displacement (m).
        rotation: (3,) set-point of the wrist's rotation vector (rad).
        is_released: Whether the object has been released.
        is_opening: Whether the hand opens after a voluntary release.
    """

    rate: float
    displacement: npt.NDArray[np.floating]
    rotation: npt.NDArray[np.floating]
    is_released: bool
    is_opening: bool


class Playback:
    """Playback of a recorded scene with the giver's deviations; it stays at the last frame.

    `plan` returns the reference motion of the next physics steps, `commit` applies as many of them as
    were simulated. Hand and held object deviate together, rigidly about the wrist, and only after the
    object has been picked up, because until then the hand must reach it.

    Args:
        scene: Scene to play.
        config: Limits of the deviation from the recording.

    Attributes:
        scene: Scene that is played.
    """

    def __init__(self, scene: Scene, config: GiverConfig) -> None:
        self.scene = scene
        self._config = config
        self._pick_up_frame = find_pick_up_frame(scene)
        self._wrist_in_base = find_wrist_in_base(scene)
        self._last_frame = scene.n_frames - 1
        self._hand_present = scene.is_hand_present(np.arange(scene.n_frames))
        self._now = _PlaybackState(self.read_first_frame())
        self._planned: tuple[_Command, ReferenceMotion, _PlaybackState] | None = None

    @property
    def frame(self) -> int:
        """Current frame of the recording, 0 at the start."""
        return self._now.frame

    @property
    def holding(self) -> bool:
        """Whether the person has picked up the object, so that displacements take effect."""
        return self._pick_up_frame is not None and self.frame >= self._pick_up_frame

    @property
    def opening_progress(self) -> float:
        """Progress of the hand's opening after a voluntary release, 0 to 1."""
        return self._now.opening_progress

    @property
    def deviation(self) -> npt.NDArray[np.float32]:
        """(7,) current playback rate minus 1, wrist displacement (m) and rotation vector (rad)."""
        now = self._now
        return np.array([now.rate, *now.displacement.value, *now.rotation.value], dtype=np.float32)

    def read_first_frame(self) -> ReferenceMotion:
        """Return the first frame of the recording as a reference motion of one row."""
        return self._read_frames(np.array([0]))

    def plan(
        self,
        steps: int,
        action: npt.NDArray[np.float32] = NO_DEVIATION,
        released: bool = False,
        is_opening: bool = False,
    ) -> ReferenceMotion:
        """Return the reference motion of the next physics steps, without advancing the playback.

        Args:
            steps: Number of physics steps.
            action: (8,) action of the giver; default: replay the recording.
            released: Whether the object has been released, so that it does not follow the hand.
            is_opening: Whether the hand opens after a voluntary release.
        """
        wanted = GiverAction.from_array(action)
        # An object that is picked up during these steps must not move early.
        holding = self.holding
        command = _Command(wanted.rate, holding * wanted.displacement, holding * wanted.rotation, released, is_opening)
        motion, state = self._compute_motion(command, steps)
        self._planned = command, motion, state
        return motion

    def commit(self, steps: int) -> None:
        """Advance the playback by the number of planned steps that were simulated.

        Raises:
            ValueError: No motion has been planned.
        """
        if self._planned is None:
            raise ValueError("no motion has been planned; call plan() first")
        command, motion, state = self._planned
        self._planned = None
        if steps:
            # An episode may end before all planned steps are simulated.
            self._now = state if steps == len(motion.hand) else self._compute_motion(command, steps)[1]

    def _compute_motion(self, command: _Command, steps: int) -> tuple[ReferenceMotion, _PlaybackState]:
        now = self._now
        frames, clock, rate = self._advance_clock(command.rate, steps)
        motion = self._read_frames(frames, consecutive=now.rate == 0.0 == rate)
        has_deviated = now.has_deviated or bool(command.displacement.any() or command.rotation.any())
        displacement, rotation, progress = now.displacement, now.rotation, now.opening_progress
        # After a deviation, Euler angles may differ from the recorded ones by full turns.
        if has_deviated:
            motion, displacement, rotation = self._offset_motion(motion, command)
        if command.is_opening:
            motion, progress = self._open_hand(motion)
        state = _PlaybackState(motion, clock, int(frames[-1]), rate, displacement, rotation, has_deviated, progress)
        return motion, state

    def _advance_clock(self, target_rate: float, steps: int) -> tuple[Indices, float, float]:
        """Return the frames played in the next steps, and playback time and rate after them."""
        now, last = self._now, self._last_frame
        if target_rate == 0.0 == now.rate and now.clock.is_integer():
            # Shortcut for a plain replay.
            first = int(now.clock) + 1
            return np.minimum(np.arange(first, first + steps), last), now.clock + steps, 0.0
        rates = self._ramp_rate(target_rate, steps)
        clock = now.clock + np.cumsum(1.0 + rates)
        return np.minimum(_round_frames(clock), last).astype(int), float(clock[-1]), float(rates[-1])

    def _ramp_rate(self, target_rate: float, steps: int) -> npt.NDArray[np.float64]:
        """Return playback rates minus 1 that approach a target with limited slope."""
        rate = self._now.rate
        if target_rate == rate:
            return np.full(steps, target_rate)
        limits = np.arange(1, steps + 1) * (self._config.rate_change * TIME_STEP)
        change = np.clip(target_rate - rate, -limits, limits)
        is_limited = np.abs(change) < abs(target_rate - rate)
        rates: npt.NDArray[np.float64] = np.where(is_limited, rate + change, target_rate)
        return rates

    def _offset_motion(
        self, motion: ReferenceMotion, command: _Command
    ) -> tuple[ReferenceMotion, TrackedVector, TrackedVector]:
        steps, now, config = len(motion.hand), self._now, self._config
        displacements, displacement = track_set_point(
            now.displacement, command.displacement, steps, config.speed, config.acceleration
        )
        rotations, rotation = track_set_point(
            now.rotation, command.rotation, steps, config.turn_speed, config.turn_acceleration
        )
        bases, objects = motion.hand[:, :BASE_JOINTS], motion.objects[:, 0]
        # Rows are equal at rest, for example after the recording's end: compute one of them.
        if all((rows == rows[0]).all() for rows in (displacements, rotations, bases, objects)):
            displacements, rotations, bases, objects = displacements[:1], rotations[:1], bases[:1], objects[:1]
        bodies = [bases] if command.is_released else [bases, objects]
        previous = [now.motion.hand[-1, :BASE_JOINTS], now.motion.objects[-1, 0]][: len(bodies)]
        moved = apply_wrist_offset(bodies, self._wrist_in_base, displacements, rotations, previous)
        moved_hand, moved_objects = motion.hand.copy(), motion.objects.copy()
        moved_hand[:, :BASE_JOINTS] = moved[0]
        if not command.is_released:
            moved_objects[:, 0] = moved[1]
        return ReferenceMotion(moved_objects, moved_hand, motion.hand_present), displacement, rotation

    def _open_hand(self, motion: ReferenceMotion) -> tuple[ReferenceMotion, float]:
        """Move the finger angles towards zero, which is a flat hand in MANO."""
        pace = TIME_STEP / self._config.opening_time
        progress = np.minimum(self._now.opening_progress + pace * np.arange(1, len(motion.hand) + 1), 1.0)
        hand = motion.hand.copy()
        hand[:, BASE_JOINTS:] *= (1.0 - self._config.opening * progress[:, None]).astype(np.float32)
        return ReferenceMotion(motion.objects, hand, motion.hand_present), float(progress[-1])

    def _read_frames(self, frames: Indices, consecutive: bool = False) -> ReferenceMotion:
        scene, first, last = self.scene, int(frames[0]), int(frames[-1])
        # A slice needs no copy; at the recording's end, frames repeat and are not consecutive.
        rows = slice(first, last + 1) if consecutive and last - first == len(frames) - 1 else frames
        return ReferenceMotion(scene.object_dof[rows], scene.hand_dof[rows], self._hand_present[rows])


def _round_frames(clock: npt.ArrayLike) -> npt.NDArray[np.float64]:
    # Rates often sum to halves; rounding to 9 digits first keeps float noise from deciding.
    return np.rint(np.round(np.asarray(clock, dtype=np.float64), 9))


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
