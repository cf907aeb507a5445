"""What is noted of an episode while it is played, for metrics beyond the official ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, TIME_STEP
from handover_marl.episode.watchers import Watcher
from handover_marl.models.motion_frames import motion_frames
from handover_marl.models.panda import HAND_LINK

if TYPE_CHECKING:
    from handover_marl.episode.episode import Episode
    from handover_marl.sim.gap import GapMeter

Array = npt.NDArray[np.float64]

#: Physics steps between two samples of motion and gap (20 ms); the first sample is the start.
SAMPLE_STEPS = 20

_WRIST_LINK = 6


@dataclass(frozen=True, eq=False)
class Track:
    """An episode's motion, sampled at equal times from its start on; world frame.

    Attributes:
        gripper: (n, 3) places of the Panda's hand link (m).
        fingers: (n, 2) places of the two fingers (m).
        wrist: (n, 3) places of the person's wrist (m), NaN where there is no hand.
        steps: Physics steps that the episode took.
        release_step: The step after which the person let go, or None.
        peak_force: Largest sum of the normal forces between robot and object in a physics step (N).
        gap: Smallest distance of robot and hand (m), or None without a hand.
        sample_steps: Physics steps between two samples.
    """

    gripper: Array
    fingers: Array
    wrist: Array
    steps: int
    release_step: int | None
    peak_force: float
    gap: float | None
    sample_steps: int = SAMPLE_STEPS

    @property
    def period(self) -> float:
        """Time between samples (s)."""
        return self.sample_steps * TIME_STEP

    @property
    def duration(self) -> float:
        """Of the episode (s)."""
        return self.steps * TIME_STEP

    @property
    def release(self) -> float | None:
        """When the person let go (s), or None."""
        return None if self.release_step is None else self.release_step * TIME_STEP

    def samples_until(self, step: int) -> int:
        """How many samples there are up to a step, the start's and the step's own counted."""
        return min(step // self.sample_steps + 1, len(self.gripper))


class Recorder(Watcher):
    """Makes the track of every episode that it watches.

    Attributes:
        track: Of the last episode, once it has ended.
    """

    track: Track

    def __init__(self) -> None:
        self._meters: dict[Path, GapMeter] = {}

    def started(self, episode: "Episode") -> None:
        """Forget the last episode."""
        self._robot: list[npt.NDArray[np.float32]] = []
        self._hand: list[npt.NDArray[np.float32] | None] = []
        self._peak_force = 0.0
        self._touched = False
        self._sample(episode)

    def stepped(self, episode: "Episode") -> None:
        """Take note of contacts, and now and then of where everything is."""
        contacts = episode.contacts
        if contacts.robot_object_force > self._peak_force:
            self._peak_force = contacts.robot_object_force
        self._touched = self._touched or contacts.robot_hand
        if episode.steps % SAMPLE_STEPS == 0:
            self._sample(episode)

    def ended(self, episode: "Episode") -> None:
        """Make the track; the end counts for the gap though it may lie between two samples."""
        n_samples = len(self._robot)
        self._sample(episode)
        panda = episode.config.physics.panda
        robot = np.array(self._robot, dtype=np.float64)
        there = np.array([hand is not None for hand in self._hand])
        hand = np.array([row for row in self._hand if row is not None], dtype=np.float64).reshape(-1, HAND_DOF)
        assets = episode.scene.assets
        base = [*panda.base_position, *panda.base_orientation]
        robot_frames = motion_frames(assets.panda, robot, base)
        wrist = np.full((len(robot), 3), np.nan)
        gap: float | None = None
        if there.any():
            hand_frames = motion_frames(assets.hand, hand)
            wrist[there] = hand_frames.path(_WRIST_LINK)
            meter = self._meter(episode)
            gap = meter.smallest(assets.hand, robot[there], hand, robot_frames.at(there), hand_frames)
        self.track = Track(
            gripper=robot_frames.path(HAND_LINK)[:n_samples],
            fingers=robot[:n_samples, 7:],
            wrist=wrist[:n_samples],
            steps=episode.steps,
            release_step=episode.release_step,
            peak_force=self._peak_force,
            gap=0.0 if self._touched else gap,
        )

    def close(self) -> None:
        """Free the simulation that gaps are measured in."""
        for meter in self._meters.values():
            meter.close()
        self._meters.clear()

    def _sample(self, episode: "Episode") -> None:
        robot, hand = episode.world.postures()
        self._robot.append(robot)
        self._hand.append(hand)

    def _meter(self, episode: "Episode") -> "GapMeter":
        urdf = episode.scene.assets.panda
        if urdf not in self._meters:
            from handover_marl.sim.gap import GapMeter

            self._meters[urdf] = GapMeter(urdf, episode.config.physics.panda)
        return self._meters[urdf]
