"""Motion trace of an episode, and the callback that records it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, TIME_STEP
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.metrics.motion_analysis import compute_protective_distances, compute_speeds
from handover_marl.geometry.kinematic_tree import compute_link_trajectory
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.clearance import ClearanceMonitor
from handover_marl.simulation.engines import make_distance_query
from handover_marl.simulation.reference_tracking import WRIST_LINK

if TYPE_CHECKING:
    from handover_marl.episode.episode import Episode

Array = npt.NDArray[np.float64]

#: Physics steps between two samples of an episode's trace (20 ms); the first sample is the start.
SAMPLE_STEPS = 20


@dataclass(frozen=True, eq=False)
class EpisodeTrace:
    """Motion trace of an episode, sampled at equal intervals from its start; world frame.

    Attributes:
        gripper: (n, 3) positions of the Panda's hand link (m).
        fingers: (n, 2) positions of the finger joints (m).
        wrist: (n, 3) positions of the person's wrist (m), NaN without a hand.
        steps: Number of physics steps of the episode.
        release_step: Physics step after which the person released the object; None without a
            release.
        max_object_force: Largest sum of the normal forces between robot and object in one physics step (N).
        min_distance: Smallest distance between robot and human hand (m), 0 after contact, None
            without a hand.
        max_hand_force: Largest sum of the normal forces between robot and human hand in one physics
            step (N); None without contact.
        hand_impulse: Sum over all physics steps of the normal forces between robot and human hand,
            times the duration of a step (N s); None without contact.
        contact_step: First physics step in which the robot touched the object; None without contact.
        object_impulse: Sum over the physics steps until the release of the normal forces between robot and
            object, times the duration of a step (N s).
        min_separation_margin: Smallest distance between robot and human hand minus the protective distance
            of `compute_protective_distances` (m); None without a hand.
        side: Side of the human hand, "right" or "left".
        sample_steps: Physics steps between two samples.
    """

    gripper: Array
    fingers: Array
    wrist: Array
    steps: int
    release_step: int | None
    max_object_force: float
    min_distance: float | None
    max_hand_force: float | None = None
    hand_impulse: float | None = None
    contact_step: int | None = None
    object_impulse: float = 0.0
    min_separation_margin: float | None = None
    side: str = "right"
    sample_steps: int = SAMPLE_STEPS

    @property
    def period(self) -> float:
        """Time between two samples (s)."""
        return self.sample_steps * TIME_STEP

    @property
    def duration(self) -> float:
        """Duration of the episode (s)."""
        return self.steps * TIME_STEP

    @property
    def release_time(self) -> float | None:
        """Time of the release of the object (s), or None without a release."""
        return None if self.release_step is None else self.release_step * TIME_STEP

    def count_samples_until(self, step: int) -> int:
        """Return the number of samples up to a physics step, both ends included."""
        return min(step // self.sample_steps + 1, len(self.gripper))


class TraceRecorder(EpisodeCallback):
    """Recorder of the motion trace of each episode.

    Attributes:
        trace: Motion trace of the last episode; set at the end of the episode.
    """

    trace: EpisodeTrace

    def __init__(self) -> None:
        self._monitors: dict[Path, ClearanceMonitor] = {}
        self._robot: list[npt.NDArray[np.float32]] = []
        self._hand: list[npt.NDArray[np.float32] | None] = []
        self._max_object_force, self._object_impulse = 0.0, 0.0
        self._contact_step: int | None = None
        self._hand_forces: list[float] = []

    def on_reset(self, episode: "Episode") -> None:
        """Discard the records of the last episode."""
        self._robot, self._hand = [], []
        self._max_object_force, self._object_impulse, self._contact_step = 0.0, 0.0, None
        self._hand_forces = []
        self._sample(episode)

    def on_step(self, episode: "Episode") -> None:
        """Record contacts in every step, and joint positions every `SAMPLE_STEPS` steps."""
        contacts = episode.contacts
        self._max_object_force = max(self._max_object_force, contacts.robot_object_force)
        if contacts.robot_touches_object:
            if self._contact_step is None:
                self._contact_step = episode.steps
            if episode.release_step is None or episode.steps <= episode.release_step:
                self._object_impulse += contacts.robot_object_force * TIME_STEP
        if contacts.robot_touches_hand:
            self._hand_forces.append(contacts.robot_hand_force)
        if episode.steps % SAMPLE_STEPS == 0:
            self._sample(episode)

    def on_end(self, episode: "Episode") -> None:
        """Build the motion trace of the episode; the last step counts for the smallest distance."""
        n_samples = len(self._robot)
        self._sample(episode)
        panda, assets = episode.config.physics.panda, episode.scene.assets
        robot = np.array(self._robot, dtype=np.float64)
        has_hand = np.array([hand is not None for hand in self._hand])
        hand = np.array([row for row in self._hand if row is not None], dtype=np.float64).reshape(-1, HAND_DOF)
        robot_frames = compute_link_trajectory(assets.panda, robot, [*panda.base_position, *panda.base_orientation])
        wrist = np.full((len(robot), 3), np.nan)
        min_distance: float | None = None
        min_margin: float | None = None
        if has_hand.any():
            hand_frames = compute_link_trajectory(assets.hand, hand)
            wrist[has_hand] = hand_frames.get_positions(WRIST_LINK)
            if assets.panda not in self._monitors:
                query = make_distance_query(assets.panda, panda)
                self._monitors[assets.panda] = ClearanceMonitor(assets.panda, panda, query)
            monitor, gripper = self._monitors[assets.panda], robot_frames.get_positions(HAND_LINK)
            motion = assets.hand, robot[has_hand], hand, robot_frames.select(has_hand), hand_frames
            min_distance = 0.0 if self._hand_forces else monitor.compute_min_distance(*motion)
            protective = self._compute_protective_distances(wrist, gripper, n_samples)
            min_margin = monitor.compute_min_margin(*motion, protective[has_hand])
            if self._hand_forces:
                min_margin = min(min_margin, -float(protective[-1]))
        self.trace = EpisodeTrace(
            gripper=robot_frames.get_positions(HAND_LINK)[:n_samples],
            fingers=robot[:n_samples, 7:],
            wrist=wrist[:n_samples],
            steps=episode.steps,
            release_step=episode.release_step,
            max_object_force=self._max_object_force,
            min_distance=min_distance,
            max_hand_force=max(self._hand_forces, default=None),
            hand_impulse=sum(self._hand_forces) * TIME_STEP if self._hand_forces else None,
            contact_step=self._contact_step,
            object_impulse=self._object_impulse,
            min_separation_margin=min_margin,
            side=episode.scene.info.side,
        )

    def close(self) -> None:
        """Free the simulation that measures distances between robot and human hand."""
        for monitor in self._monitors.values():
            monitor.close()
        self._monitors.clear()

    @staticmethod
    def _compute_protective_distances(wrist: Array, gripper: Array, n_samples: int) -> Array:
        """Return the protective distance at each sample; the last step has the speeds of the last sample."""
        period = SAMPLE_STEPS * TIME_STEP
        speeds = (compute_speeds(positions[:n_samples], period) for positions in (wrist, gripper))
        distances = compute_protective_distances(*speeds)
        return np.append(distances, distances[-1])

    def _sample(self, episode: "Episode") -> None:
        joints = episode.world.read_agent_joints()
        self._robot.append(joints.robot)
        self._hand.append(joints.hand)
