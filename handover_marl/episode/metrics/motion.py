"""Motion trace of an episode, the callback that records it, and quantities that are computed from sampled motion.

The quantities are speeds, activities, jerk, smoothness and protective distances.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, TIME_STEP
from handover_marl.episode.loop import EpisodeCallback
from handover_marl.geometry.kinematic_tree import compute_link_trajectory, read_tree
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.reference_tracking import WRIST_LINK

if TYPE_CHECKING:
    from handover_marl.episode.episode import Episode
    from handover_marl.simulation.mujoco.clearance_monitor import ClearanceMonitor

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

#: Physics steps between two samples of an episode's trace (20 ms); the first sample is the start.
SAMPLE_STEPS = 20
_SMOOTHING_SAMPLES = 3  # speeds are averaged over 80 ms
_SHORTEST_PAUSE = 0.25  # s, shorter pauses do not divide an activity
# The jerk is the third derivative of a polynomial of this degree, fitted to this many samples (240 ms). The filter has
# half power at 6.3 Hz: it keeps reaching movements and suppresses noise.
_JERK_DEGREE, _JERK_SAMPLES = 5, 13
# Spectral arc length: highest frequency (Hz); share of the largest amplitude below which both ends of the spectrum are
# cut off; the speed profile is padded with zeros to 2^_PADDING times the next power of two.
_CUTOFF, _THRESHOLD, _PADDING = 10.0, 0.05, 4
#: Time from the detection of a person to the start of the robot's braking (s), as assumed for protective distances.
REACTION_TIME = 0.1
#: Deceleration of the gripper while the robot brakes (m/s^2): the limit of the Panda's translational acceleration
#: in the interface specification of Franka Robotics.
BRAKING_DECELERATION = 13.0


@dataclass(frozen=True, eq=False)
class EpisodeTrace:
    """Motion trace of an episode, sampled at equal intervals from its start; world frame.

    Attributes:
        gripper: (n, 3) positions of the Panda's hand link (m).
        fingers: (n, 2) positions of the finger joints (m).
        wrist: (n, 3) positions of the person's wrist (m), NaN if there is no hand.
        steps: Number of physics steps of the episode.
        release_step: Physics step in which the person released the object; None if there is no release.
        forces: (n, 2) sums of the robot's normal forces on the object, and on the person's hand (N), each the largest
            in the physics steps since the previous sample. The last sample includes the steps after it.
        min_distance: Smallest distance between robot and human hand (m), 0 after contact, None if there is no hand.
        max_hand_force: Largest sum of the normal forces between robot and human hand in one physics step (N); None
            without contact.
        hand_impulse: Sum over all physics steps of the normal forces between robot and human hand,
            times the duration of a step (N s); None if there is no contact.
        contact_step: First physics step in which the robot touched the object; None if there is no contact.
        object_impulse: Sum over the physics steps until the release or the end of the normal forces between
            robot and object, times the duration of a step (N s).
        min_separation_margin: Smallest separation margin (m): distance between robot and human hand minus the
            distance of `compute_protective_distances`; None if there is no hand.
        side: Side of the human hand, "right" or "left".
    """

    gripper: Array
    fingers: Array
    wrist: Array
    steps: int
    release_step: int | None
    forces: Array
    min_distance: float | None
    max_hand_force: float | None = None
    hand_impulse: float | None = None
    contact_step: int | None = None
    object_impulse: float = 0.0
    min_separation_margin: float | None = None
    side: str = "right"

    @property
    def period(self) -> float:
        """Time between two samples (s)."""
        return SAMPLE_STEPS * TIME_STEP

    @property
    def max_object_force(self) -> float:
        """Largest sum of the normal forces between robot and object in one physics step (N)."""
        return float(self.forces[:, 0].max())

    @property
    def duration(self) -> float:
        """Duration of the episode (s)."""
        return self.steps * TIME_STEP

    @property
    def release_time(self) -> float | None:
        """Time of the release of the object (s), or None if there is no release."""
        return None if self.release_step is None else self.release_step * TIME_STEP

    def count_samples_until(self, step: int) -> int:
        """Return the number of samples from the start to a physics step, both included."""
        return min(step // SAMPLE_STEPS + 1, len(self.gripper))


class TraceRecorder(EpisodeCallback):
    """Recorder of the motion trace of each episode.

    Attributes:
        trace: Motion trace of the last episode; set at the end of the episode.
    """

    trace: EpisodeTrace

    def __init__(self) -> None:
        self._monitors: dict[tuple[Path, Path], ClearanceMonitor] = {}

    def on_reset(self, episode: "Episode") -> None:
        """Discard the records of the last episode."""
        self._robot: list[npt.NDArray[np.float32]] = []
        self._hand: list[npt.NDArray[np.float32] | None] = []
        self._forces: list[tuple[float, float]] = []
        self._object_impulse = 0.0
        self._contact_step: int | None = None
        self._hand_forces: list[float] = []
        self._sample(episode)

    def on_step(self, episode: "Episode") -> None:
        """Record contacts in every step, and joint positions of robot and human hand every `SAMPLE_STEPS` steps."""
        contacts = episode.contacts
        self._forces.append((contacts.robot_object_force, contacts.robot_hand_force))
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
        """Build `trace`; the smallest distance and the smallest margin include the last physics step."""
        n_samples = len(self._robot)
        self._sample(episode)
        panda, assets = episode.config.physics.panda, episode.scene.assets
        robot = np.array(self._robot, dtype=np.float64)
        has_hand = np.array([hand is not None for hand in self._hand])
        hand = np.array([row for row in self._hand if row is not None], dtype=np.float64).reshape(-1, HAND_DOF)
        robot_frames = compute_link_trajectory(assets.panda, robot, [*panda.base_position, *panda.base_orientation])
        gripper = robot_frames[0][:, read_tree(assets.panda).get_link(HAND_LINK)]
        wrist = np.full((len(robot), 3), np.nan)
        min_distance: float | None = None
        min_margin: float | None = None
        if has_hand.any():
            hand_frames = compute_link_trajectory(assets.hand, hand)
            wrist[has_hand] = hand_frames[0][:, WRIST_LINK]
            models, (origins, rotations) = (assets.panda, assets.hand), robot_frames
            if models not in self._monitors:
                # MuJoCo takes long to import.
                from handover_marl.simulation.mujoco.clearance_monitor import ClearanceMonitor

                self._monitors[models] = ClearanceMonitor(*models, panda)
            monitor = self._monitors[models]
            motion = robot[has_hand], hand, (origins[has_hand], rotations[has_hand]), hand_frames
            min_distance = 0.0 if self._hand_forces else monitor.compute_min_margin(*motion)
            protective = compute_sampled_distances(wrist, gripper, n_samples)
            min_margin = monitor.compute_min_margin(*motion, protective[has_hand])
            if self._hand_forces:
                min_margin = min(min_margin, -float(protective[-1]))
        forces, steps = np.zeros((n_samples, 2)), np.arange(len(self._forces))
        rows = np.minimum(steps // SAMPLE_STEPS + 1, n_samples - 1)
        np.maximum.at(forces, rows, np.reshape(self._forces, (-1, 2)))
        self.trace = EpisodeTrace(
            gripper=gripper[:n_samples],
            fingers=robot[:n_samples, 7:],
            wrist=wrist[:n_samples],
            steps=episode.steps,
            release_step=episode.release_step,
            forces=forces,
            min_distance=min_distance,
            max_hand_force=max(self._hand_forces, default=None),
            hand_impulse=sum(self._hand_forces) * TIME_STEP if self._hand_forces else None,
            contact_step=self._contact_step,
            object_impulse=self._object_impulse,
            min_separation_margin=min_margin,
            side=episode.scene.info.side,
        )

    def _sample(self, episode: "Episode") -> None:
        joints = episode.world.read_joint_snapshot()
        self._robot.append(joints.robot)
        self._hand.append(joints.hand)


def compute_speeds(positions: Array, period: float) -> Array:
    """Compute the speeds (n,) in m/s at positions (n, k), averaged over 3 samples; NaN speeds count as 0.

    Args:
        positions: (n, k) positions (m).
        period: Time between two positions (s).
    """
    if len(positions) < 2:
        return np.zeros(len(positions))
    speed = np.linalg.norm(np.gradient(positions, period, axis=0), axis=1)
    speed = np.nan_to_num(speed, nan=0.0)
    padded = np.pad(speed, _SMOOTHING_SAMPLES // 2, mode="edge")
    return np.convolve(padded, np.full(_SMOOTHING_SAMPLES, 1.0 / _SMOOTHING_SAMPLES), mode="valid")


def compute_rms_jerk(positions: Array, period: float) -> float | None:
    """Compute the root mean square of the jerk of a motion (m/s^3); None for fewer than 13 positions.

    The jerk at a position is the third derivative of a polynomial of fifth degree (like a minimum-jerk motion) that is
    fitted to 13 positions around it. The first and the last six positions are left out.

    Args:
        positions: (n, k) positions (m).
        period: Time between two positions (s).
    """
    if len(positions) < _JERK_SAMPLES:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(positions, _JERK_SAMPLES, axis=0)
    jerk = windows @ _compute_jerk_weights() / period**3
    return float(np.sqrt(np.mean(np.sum(jerk**2, axis=1))))


@functools.cache
def _compute_jerk_weights() -> Array:
    """Compute weights (13,); the weighted sum of 13 samples, one unit apart, is the third derivative in the middle."""
    offsets = np.arange(_JERK_SAMPLES) - _JERK_SAMPLES // 2
    weights: Array = 6.0 * np.linalg.pinv(np.vander(offsets, _JERK_DEGREE + 1, increasing=True))[3]
    return weights


def compute_spectral_arc_length(speed: Array, rate: float) -> float | None:
    """Compute the spectral arc length (SPARC) of a speed profile, at most 0; values closer to 0 are smoother.

    It is minus the arc length of the amplitude spectrum (Balasubramanian et al., 2015), in the range from the first to
    the last frequency up to 10 Hz whose amplitude is at least 5 % of the largest one. Amplitudes are divided by the
    largest one, and frequencies by the width of this range. None if all speeds are zero.

    Args:
        speed: (n,) speeds at equal intervals.
        rate: Sampling rate (Hz).
    """
    if not np.any(speed):
        return None
    length = 2 ** (int(np.ceil(np.log2(len(speed)))) + _PADDING)
    amplitude = np.abs(np.fft.rfft(speed, length))
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    amplitude = amplitude / amplitude.max()
    is_low = frequency <= _CUTOFF
    amplitude, frequency = amplitude[is_low], frequency[is_low]
    large = np.flatnonzero(amplitude >= _THRESHOLD)
    part = slice(large[0], large[-1] + 1)
    amplitude, frequency = amplitude[part], frequency[part]
    if len(frequency) < 2:
        return 0.0
    across = np.diff(frequency) / (frequency[-1] - frequency[0])
    return float(-np.sum(np.hypot(across, np.diff(amplitude))))


def find_activities(active: Flags, period: float) -> list[tuple[int, int]]:
    """Return first and last sample (indices) of each period of activity; pauses of up to 0.25 s do not end a period.

    Args:
        active: (n,) whether the agent is active at each sample.
        period: Time between two samples (s).
    """
    runs: list[tuple[int, int]] = []
    for sample in np.flatnonzero(active).tolist():
        if runs and (sample - runs[-1][1]) * period <= _SHORTEST_PAUSE:
            runs[-1] = (runs[-1][0], sample)
        else:
            runs.append((sample, sample))
    return runs


def compute_protective_distances(person_speeds: Array, robot_speeds: Array) -> Array:
    """Compute the protective separation distances (n,) of person and robot (m) by ISO/TS 15066:2016, 5.5.4.

    The distance is the sum of the paths of the person until the robot stands still, of the robot until it starts to
    brake, and of the robot while it brakes with constant deceleration. Person and robot are assumed to move towards
    each other. The intrusion distance and the position uncertainties of the standard are zero in simulation.

    Args:
        person_speeds: (n,) speeds of the person (m/s).
        robot_speeds: (n,) speeds of the robot (m/s).
    """
    braking_time = robot_speeds / BRAKING_DECELERATION
    person = person_speeds * (REACTION_TIME + braking_time)
    distances: Array = person + robot_speeds * REACTION_TIME + 0.5 * robot_speeds * braking_time
    return distances


def compute_sampled_distances(wrist: Array, gripper: Array, n_samples: int) -> Array:
    """Compute the protective distances (n + 1,) in m at n samples and at the last step; the last two are equal.

    Args:
        wrist: (n + 1, 3) positions of the wrist at the samples and the last step (m), NaN if there is no hand.
        gripper: (n + 1, 3) positions of the gripper (m).
        n_samples: Number n of samples.
    """
    period = SAMPLE_STEPS * TIME_STEP
    speeds = (compute_speeds(positions[:n_samples], period) for positions in (wrist, gripper))
    distances = compute_protective_distances(*speeds)
    return np.append(distances, distances[-1])
