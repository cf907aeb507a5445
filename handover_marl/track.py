"""What is noted of an episode while it is played, for metrics beyond the official ones."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.protocol.contacts import Contacts
from handover_marl.scene import Scene
from handover_marl.sim.gap import GapMeter
from handover_marl.sim.world import WorldState

#: Physics steps between two samples of motion and gap (20 ms).
SAMPLE_STEPS = 20

_NOWHERE = np.full(3, np.nan, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Track:
    """An episode's motion, sampled at equal times; world frame.

    Attributes:
        period: Time between samples (s).
        gripper: (n, 3) places of the Panda's hand link (m).
        fingers: (n, 2) places of the two fingers (m).
        wrist: (n, 3) places of the person's wrist (m), NaN where there is no hand.
        duration: Of the episode (s).
        release: When the person let go (s), or None.
        peak_force: Largest sum of the normal forces between robot and object in a physics step (N).
        gap: Smallest distance of robot and hand (m), or None without a hand.
    """

    period: float
    gripper: npt.NDArray[np.float64]
    fingers: npt.NDArray[np.float64]
    wrist: npt.NDArray[np.float64]
    duration: float
    release: float | None
    peak_force: float
    gap: float | None


class Recorder:
    """Makes the track of one episode.

    Args:
        scene: What is played.
    """

    def __init__(self, scene: Scene) -> None:
        self._meter = GapMeter(scene.assets.panda, scene.assets.hand)
        self._time_step = PhysicsConfig().time_step
        self._samples: list[npt.NDArray[np.float32]] = []
        self._peak_force = 0.0
        self._touched = False

    def touch(self, contacts: Contacts) -> None:
        """Take note of a physics step's contacts."""
        self._peak_force = max(self._peak_force, contacts.robot_object_force)
        self._touched = self._touched or contacts.robot_hand

    def due(self, steps: int) -> bool:
        """Whether a state is wanted after so many steps."""
        return steps % SAMPLE_STEPS == 0

    def sample(self, state: WorldState) -> None:
        """Take note of a state; wanted whenever one is due."""
        keypoints = state.hand_keypoints
        wrist = _NOWHERE if keypoints is None else keypoints[0]
        self._samples.append(np.concatenate([state.gripper_pose[:3], state.robot_joint_position[7:], wrist]))
        self._meter.measure(state)

    def finish(self, state: WorldState, steps: int, release_step: int | None) -> Track:
        """The track of the finished episode.

        Args:
            state: At its end.
            steps: Physics steps played.
            release_step: When the person let go, or None.
        """
        self._meter.measure(state)
        gap = 0.0 if self._touched else self._meter.smallest
        self._meter.close()
        rows = np.array(self._samples, dtype=np.float64)
        return Track(
            period=SAMPLE_STEPS * self._time_step,
            gripper=rows[:, :3],
            fingers=rows[:, 3:5],
            wrist=rows[:, 5:],
            duration=steps * self._time_step,
            release=None if release_step is None else release_step * self._time_step,
            peak_force=self._peak_force,
            gap=gap if np.isfinite(gap) else None,
        )
