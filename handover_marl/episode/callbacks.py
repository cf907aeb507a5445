"""Callbacks of the episode loop: base class, recorders of actions and of motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, PANDA_DOF, TIME_STEP
from handover_marl.geometry.link_trajectory import compute_link_trajectory
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.clearance import ClearanceMonitor
from handover_marl.simulation.engines import make_distance_query
from handover_marl.simulation.kinematic_paths import WRIST_LINK

if TYPE_CHECKING:
    from handover_marl.episode.episode import Episode

Array = npt.NDArray[np.float64]

#: Physics steps between two samples of an episode's trace (20 ms); the first sample is the start.
SAMPLE_STEPS = 20


@dataclass(frozen=True, eq=False)
class PolicyDecision:
    """Actions of both policies for the next physics steps.

    Attributes:
        receiver_action: (9,) action of the receiver.
        giver_action: (8,) action of the giver.
        planning_time: Wall-clock time of the receiver's policy (s), without rendering; 0 if its last
            action is held.
        receiver_decided: Whether the receiver's policy acted now; otherwise its last action is held.
        giver_decided: Whether the giver's policy acted now; always false for a replayed giver.
        rendering_time: Wall-clock time for rendering the receiver's camera data (s).
    """

    receiver_action: npt.NDArray[np.float32]
    giver_action: npt.NDArray[np.float32]
    planning_time: float
    receiver_decided: bool
    giver_decided: bool
    rendering_time: float


class EpisodeCallback:
    """Base class of callbacks of the episode loop; subclasses override the hooks that they need.

    Callbacks read the episode and do not change it.
    """

    def on_reset(self, episode: "Episode") -> None:
        """Handle the start of an episode; the base class does nothing."""

    def on_decision(self, episode: "Episode", decision: PolicyDecision) -> None:
        """Handle new actions of both policies, before the simulation applies them."""

    def on_step(self, episode: "Episode") -> None:
        """Handle a physics step, after the referee has updated the episode's status."""

    def on_end(self, episode: "Episode") -> None:
        """Handle the end of the episode loop."""


class ActionRecorder(EpisodeCallback):
    """Recorder of the receiver's action and planning time in every physics step.

    HandoverSim's result files contain both.

    Attributes:
        actions: (T, 9) float32 actions; set at the end of an episode.
        times: (T,) planning times (s), zero in steps without a decision; set at the end of an episode.
    """

    actions: npt.NDArray[np.float32]
    times: npt.NDArray[np.float64]

    def __init__(self) -> None:
        self._decisions: list[tuple[int, PolicyDecision]] = []

    def on_reset(self, episode: "Episode") -> None:
        """Discard the records of the last episode."""
        self._decisions = []

    def on_decision(self, episode: "Episode", decision: PolicyDecision) -> None:
        """Record the receiver's action and planning time, and the physics step of the decision."""
        self._decisions.append((episode.steps, decision))

    def on_end(self, episode: "Episode") -> None:
        """Build the arrays of the episode, in which held actions are repeated in every step."""
        self.actions = np.zeros((episode.steps, PANDA_DOF), dtype=np.float32)
        self.times = np.zeros(episode.steps)
        ends = [step for step, _ in self._decisions[1:]] + [episode.steps]
        for (step, decision), end in zip(self._decisions, ends, strict=True):
            self.actions[step:end] = decision.receiver_action
            self.times[step] = decision.planning_time


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
        self._max_object_force = 0.0
        self._hand_forces: list[float] = []

    def on_reset(self, episode: "Episode") -> None:
        """Discard the records of the last episode."""
        self._robot, self._hand = [], []
        self._max_object_force, self._hand_forces = 0.0, []
        self._sample(episode)

    def on_step(self, episode: "Episode") -> None:
        """Record contacts in every step, and joint positions every `SAMPLE_STEPS` steps."""
        contacts = episode.contacts
        self._max_object_force = max(self._max_object_force, contacts.robot_object_force)
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
        if has_hand.any():
            hand_frames = compute_link_trajectory(assets.hand, hand)
            wrist[has_hand] = hand_frames.get_positions(WRIST_LINK)
            if assets.panda not in self._monitors:
                query = make_distance_query(assets.panda, panda)
                self._monitors[assets.panda] = ClearanceMonitor(assets.panda, panda, query)
            min_distance = self._monitors[assets.panda].compute_min_distance(
                assets.hand, robot[has_hand], hand, robot_frames.select(has_hand), hand_frames
            )
        self.trace = EpisodeTrace(
            gripper=robot_frames.get_positions(HAND_LINK)[:n_samples],
            fingers=robot[:n_samples, 7:],
            wrist=wrist[:n_samples],
            steps=episode.steps,
            release_step=episode.release_step,
            max_object_force=self._max_object_force,
            min_distance=0.0 if self._hand_forces else min_distance,
            max_hand_force=max(self._hand_forces, default=None),
            hand_impulse=sum(self._hand_forces) * TIME_STEP if self._hand_forces else None,
        )

    def close(self) -> None:
        """Free the simulation that measures distances between robot and human hand."""
        for monitor in self._monitors.values():
            monitor.close()
        self._monitors.clear()

    def _sample(self, episode: "Episode") -> None:
        joints = episode.world.read_agent_joints()
        self._robot.append(joints.robot)
        self._hand.append(joints.hand)
