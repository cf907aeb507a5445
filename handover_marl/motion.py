"""The giver's side of a handover: which poses hand and objects are led to in the coming physics steps.

This is the seam between the giver's action and the world. The zero action plays the recording back as it is.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.carrying import turn_about, wrist_points
from handover_marl.config import GiverConfig
from handover_marl.kinematic_tree import read_tree
from handover_marl.scene import Scene
from handover_marl.set_points import SetPoint
from handover_marl.spaces import GIVER_ACTION_SIZE, GiverAction

_BASE_LINK, _WRIST_LINK, _BASE_DOF = 5, 6, 6
#: The action that replays.
NO_DEVIATION = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)
NO_DEVIATION.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Motion:
    """Where hand and objects are led in each of n physics steps (world frame, m, rad).

    Attributes:
        objects: (n, m, 6) float32 joint targets of the m objects, in the scene's order.
        hand: (n, 51) float32 joint targets.
        hand_present: (n,) whether there is a hand at all.
    """

    objects: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32]
    hand_present: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.objects)

    def hand_targets(self) -> list[list[float] | None]:
        """The hand's targets as Bullet takes them, None where there is no hand."""
        return [
            row if present else None
            for row, present in zip(self.hand.tolist(), self.hand_present.tolist(), strict=True)
        ]


class Playback:
    """Plays a scene, as recorded or with the giver's deviations, and stays at its last frame.

    Hand and held object deviate together, rigidly about the wrist, once the object has been picked up: until then
    the hand has to go where the object lies.

    Args:
        scene: What is played.
        config: How fast people change what they do.
        time_step: Duration of a physics step (s).

    Attributes:
        scene: What is played.
        opened: How far the hand has opened after letting go, 0 to 1.
    """

    def __init__(self, scene: Scene, config: GiverConfig, time_step: float) -> None:
        self.scene = scene
        self.opened = 0.0
        self._config, self._time_step = config, time_step
        self._clock = 0.0
        self._rate = 0.0
        self._shift = SetPoint(3, config.speed, config.acceleration, time_step)
        self._turn = SetPoint(3, config.turn_speed, config.turn_acceleration, time_step)
        self._deviated = False
        self._picked_up = pick_up_frame(scene)
        self._wrist_place = wrist_place(scene)
        self._last = self._read(np.array([0]))

    @property
    def frame(self) -> int:
        """The frame shown, 0 at first."""
        return int(min(round(self._clock), self.scene.n_frames - 1))

    @property
    def holding(self) -> bool:
        """Whether the object has been picked up."""
        return self._picked_up is not None and self.frame >= self._picked_up

    @property
    def deviation(self) -> npt.NDArray[np.float32]:
        """(7,) playback rate, wrist displacement (m) and rotation vector (rad) as they are now."""
        return np.array([self._rate, *self._shift.value, *self._turn.value], dtype=np.float32)

    def start(self) -> Motion:
        """Where everything is before the first step: a motion of one row."""
        return self._read(np.array([0]))

    def advance(
        self,
        steps: int,
        action: npt.NDArray[np.float32] = NO_DEVIATION,
        released: bool = False,
        opening: bool = False,
    ) -> Motion:
        """Go on by some physics steps and return their targets.

        Args:
            steps: Physics steps.
            action: (8,) the giver's action.
            released: Whether the object was let go, so that it stays behind.
            opening: Whether the hand opens.
        """
        wanted = GiverAction.of(action)
        # As it is before these steps: an object that is only picked up during them must not be moved early.
        held = self.holding
        clock = self._clock + np.cumsum(1.0 + self._rates(wanted.rate, steps))
        last = self.scene.n_frames - 1
        self._clock = float(clock[-1])
        motion = self._read(np.minimum(np.rint(clock), last).astype(int))
        motion = self._deviate(motion, wanted, held, released)
        if opening:
            motion = self._open(motion)
        self._last = motion
        return motion

    def _rates(self, wanted: float, steps: int) -> npt.NDArray[np.float64]:
        """Playback rates less one, approached at a limited pace."""
        if wanted == self._rate:
            return np.full(steps, wanted)
        pace = self._config.rate_change * self._time_step
        away = np.clip(wanted - self._rate, -np.arange(1, steps + 1) * pace, np.arange(1, steps + 1) * pace)
        rates: npt.NDArray[np.float64] = np.where(
            np.abs(away) < abs(wanted - self._rate), self._rate + away, wanted
        )
        self._rate = float(rates[-1])
        return rates

    def _deviate(self, motion: Motion, wanted: GiverAction, held: bool, released: bool) -> Motion:
        shift = wanted.displacement if held else np.zeros(3)
        turn = wanted.rotation if held else np.zeros(3)
        # Once there has been a deviation the angles may have gone round another way than the recorded ones.
        self._deviated = self._deviated or bool(shift.any() or turn.any())
        if not self._deviated:
            return motion
        steps = len(motion)
        shifts, turns = self._shift.approach(shift, steps), self._turn.approach(turn, steps)
        rotations = Rotation.from_rotvec(turns)
        wrist = wrist_points(motion.hand, self._wrist_place)
        hand = motion.hand.copy()
        hand[:, :_BASE_DOF] = turn_about(
            motion.hand[:, :_BASE_DOF], wrist, shifts, rotations, self._last.hand[-1, :_BASE_DOF]
        )
        objects = motion.objects.copy()
        if not released:
            objects[:, 0] = turn_about(motion.objects[:, 0], wrist, shifts, rotations, self._last.objects[-1, 0])
        return Motion(objects, hand, motion.hand_present)

    def _open(self, motion: Motion) -> Motion:
        """Stretch the fingers; MANO's zero is a flat hand."""
        pace = self._time_step / self._config.opening_time
        shares = np.minimum(self.opened + pace * np.arange(1, len(motion) + 1), 1.0)
        self.opened = float(shares[-1])
        hand = motion.hand.copy()
        hand[:, _BASE_DOF:] *= (1.0 - self._config.opening * shares[:, None]).astype(np.float32)
        return Motion(motion.objects, hand, motion.hand_present)

    def _read(self, frames: npt.NDArray[np.int_]) -> Motion:
        scene = self.scene
        return Motion(scene.object_dof[frames], scene.hand_dof[frames], scene.hand_present(frames))


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
