"""The giver's side of a handover: which poses hand and objects are led to in the coming physics steps.

This is the seam between the giver's action and the world. The zero action plays the recording back as it is.
"""

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, GiverConfig
from handover_marl.datasets.scene import Scene
from handover_marl.episode.carrying import carried
from handover_marl.episode.set_points import SetPoint
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, GiverAction
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.sim.motion import Motion

_BASE_LINK, _WRIST_LINK, _BASE_DOF = 5, 6, 6
#: The action that replays.
NO_DEVIATION = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)
NO_DEVIATION.flags.writeable = False


@dataclass(frozen=True, eq=False)
class _State:
    """Where a playback is.

    Attributes:
        clock: Frames shown so far, pauses counted out.
        frame: The frame shown.
        rate: Playback rate less the recorded one.
        shift: The wrist's displacement on its way to its set-point.
        turn: Its rotation vector, likewise.
        deviated: Whether there ever was a deviation.
        opened: How far the hand has opened after letting go, 0 to 1.
        last: The last row that was simulated; Euler angles go on from there.
    """

    clock: float
    frame: int
    rate: float
    shift: SetPoint
    turn: SetPoint
    deviated: bool
    opened: float
    last: Motion


class Playback:
    """Plays a scene, as recorded or with the giver's deviations, and stays at its last frame.

    `plan` says where hand and objects are led in some coming steps; `commit` says how many of these were really
    simulated, and only then time goes on. Hand and held object deviate together, rigidly about the wrist, once the
    object has been picked up: until then the hand has to go where the object lies.

    Args:
        scene: What is played.
        config: How fast people change what they do.

    Attributes:
        scene: What is played.
    """

    def __init__(self, scene: Scene, config: GiverConfig) -> None:
        self.scene = scene
        self._config = config
        self._picked_up = pick_up_frame(scene)
        self._wrist_place = wrist_place(scene)
        self._now = _State(
            clock=0.0,
            frame=0,
            rate=0.0,
            shift=SetPoint(config.speed, config.acceleration),
            turn=SetPoint(config.turn_speed, config.turn_acceleration),
            deviated=False,
            opened=0.0,
            last=self._read(np.array([0])),
        )
        self._planned: tuple[_Plan, Motion, _State] | None = None

    @property
    def frame(self) -> int:
        """The frame shown, 0 at first."""
        return self._now.frame

    @property
    def holding(self) -> bool:
        """Whether the object has been picked up."""
        return self._picked_up is not None and self.frame >= self._picked_up

    @property
    def opened(self) -> float:
        """How far the hand has opened after letting go, 0 to 1."""
        return self._now.opened

    @property
    def deviation(self) -> npt.NDArray[np.float32]:
        """(7,) playback rate, wrist displacement (m) and rotation vector (rad) as they are now."""
        now = self._now
        return np.array([now.rate, *now.shift.value, *now.turn.value], dtype=np.float32)

    def start(self) -> Motion:
        """Where everything is before the first step: a motion of one row."""
        return self._read(np.array([0]))

    def plan(
        self,
        steps: int,
        action: npt.NDArray[np.float32] = NO_DEVIATION,
        released: bool = False,
        opening: bool = False,
    ) -> Motion:
        """The targets of some coming physics steps; nothing changes until they are committed.

        Args:
            steps: Physics steps.
            action: (8,) the giver's action.
            released: Whether the object was let go, so that it stays behind.
            opening: Whether the hand opens.
        """
        # Held as it is before these steps: an object that is only picked up during them must not be moved early.
        plan = _Plan(GiverAction.of(action), self.holding, released, opening)
        motion, state = self._follow(plan, steps)
        self._planned = plan, motion, state
        return motion

    def commit(self, steps: int) -> None:
        """Take note that so many of the planned steps were simulated."""
        if self._planned is None:
            raise ValueError("nothing is planned")
        plan, motion, state = self._planned
        self._planned = None
        if steps:
            # An episode may end before all of them; what follows never happened.
            self._now = state if steps == len(motion) else self._follow(plan, steps)[1]

    def _follow(self, plan: "_Plan", steps: int) -> tuple[Motion, _State]:
        now = self._now
        frames, clock, rate = self._coming(plan.wanted.rate, steps)
        motion = self._read(frames, in_turn=now.rate == 0.0 == rate)
        deviated = now.deviated or plan.deviates
        shift, turn = now.shift, now.turn
        # Once there has been a deviation the angles may have gone round another way than the recorded ones.
        if deviated:
            shift, turn = copy.copy(shift), copy.copy(turn)
            motion = self._deviate(motion, plan, shift, turn)
        opened = now.opened
        if plan.opening:
            motion, opened = self._open(motion)
        return motion, _State(clock, int(frames[-1]), rate, shift, turn, deviated, opened, motion)

    def _coming(self, wanted: float, steps: int) -> tuple[npt.NDArray[np.int_], float, float]:
        """The frames of coming steps, and clock and rate after them, towards a wanted rate less one."""
        now, last = self._now, self.scene.n_frames - 1
        if wanted == 0.0 == now.rate and now.clock.is_integer():
            # As recorded, which is most of what is ever played.
            first = int(now.clock) + 1
            return np.minimum(np.arange(first, first + steps), last), now.clock + steps, 0.0
        rates = self._rates(wanted, steps)
        clock = now.clock + np.cumsum(1.0 + rates)
        return np.minimum(_frames(clock), last).astype(int), float(clock[-1]), float(rates[-1])

    def _rates(self, wanted: float, steps: int) -> npt.NDArray[np.float64]:
        """Playback rates less one, approached at a limited pace."""
        rate = self._now.rate
        if wanted == rate:
            return np.full(steps, wanted)
        pace = self._config.rate_change * TIME_STEP
        away = np.clip(wanted - rate, -np.arange(1, steps + 1) * pace, np.arange(1, steps + 1) * pace)
        rates: npt.NDArray[np.float64] = np.where(np.abs(away) < abs(wanted - rate), rate + away, wanted)
        return rates

    def _deviate(self, motion: Motion, plan: "_Plan", shift: SetPoint, turn: SetPoint) -> Motion:
        steps, last = len(motion), self._now.last
        shifts, turns = shift.approach(plan.shift, steps), turn.approach(plan.turn, steps)
        bases, objects = motion.hand[:, :_BASE_DOF], motion.objects[:, 0]
        # What stands still, as after the recording's end, is worked out once for all steps.
        if all((rows == rows[0]).all() for rows in (shifts, turns, bases, objects)):
            shifts, turns, bases, objects = shifts[:1], turns[:1], bases[:1], objects[:1]
        carries = not plan.released
        bodies = [bases, objects] if carries else [bases]
        before = [last.hand[-1, :_BASE_DOF], last.objects[-1, 0]][: len(bodies)]
        moved = carried(bodies, self._wrist_place, shifts, turns, before)
        hand, led = motion.hand.copy(), motion.objects.copy()
        hand[:, :_BASE_DOF] = moved[0]
        if carries:
            led[:, 0] = moved[1]
        return Motion(led, hand, motion.hand_present)

    def _open(self, motion: Motion) -> tuple[Motion, float]:
        """Stretch the fingers; MANO's zero is a flat hand."""
        pace = TIME_STEP / self._config.opening_time
        shares = np.minimum(self._now.opened + pace * np.arange(1, len(motion) + 1), 1.0)
        hand = motion.hand.copy()
        hand[:, _BASE_DOF:] *= (1.0 - self._config.opening * shares[:, None]).astype(np.float32)
        return Motion(motion.objects, hand, motion.hand_present), float(shares[-1])

    def _read(self, frames: npt.NDArray[np.int_], in_turn: bool = False) -> Motion:
        scene, first, last = self.scene, int(frames[0]), int(frames[-1])
        # Frames that follow each other need not be copied; the last one is shown again and again.
        rows = slice(first, last + 1) if in_turn and last - first == len(frames) - 1 else frames
        return Motion(scene.object_dof[rows], scene.hand_dof[rows], scene.hand_present(frames))


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is wanted of some steps: the giver's action and how things stand at their start."""

    wanted: GiverAction
    held: bool
    released: bool
    opening: bool

    @property
    def shift(self) -> npt.NDArray[np.floating]:
        """(3,) set-point of the wrist's displacement (m)."""
        return self.wanted.displacement if self.held else np.zeros(3)

    @property
    def turn(self) -> npt.NDArray[np.floating]:
        """(3,) set-point of its rotation vector (rad)."""
        return self.wanted.rotation if self.held else np.zeros(3)

    @property
    def deviates(self) -> bool:
        """Whether the wrist is wanted elsewhere than recorded."""
        return bool(self.shift.any() or self.turn.any())


def _frames(clock: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The frames shown at times told in frames; at halves, to which rates often add up, no noise decides."""
    return np.rint(np.round(np.asarray(clock, dtype=np.float64), 9))


def wrist_place(scene: Scene) -> npt.NDArray[np.float64]:
    """(3,) where the wrist is in the frame that the hand's base joints carry (m)."""
    tree = read_tree(scene.assets.hand)
    origins, _ = tree.frames(np.zeros((1, tree.n_dof)))
    place: npt.NDArray[np.float64] = origins[0, _WRIST_LINK] - origins[0, _BASE_LINK]
    return place


def pick_up_frame(scene: Scene, distance: float = 0.005) -> int | None:
    """The first frame in which the object is farther than `distance` (m) from where it lay; None if it stays."""
    moved = np.linalg.norm(scene.object_dof[:, 0, :3] - scene.object_dof[0, 0, :3], axis=1) > distance
    return int(np.argmax(moved)) if moved.any() else None
