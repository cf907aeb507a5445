"""Metrics of fluency, safety and effort of a handover, in addition to HandoverSim's metrics.

Idle times, concurrent activity and functional delay follow Hoffman, "Evaluating Fluency in Human-Robot
Collaboration", IEEE Transactions on Human-Machine Systems 49(3), 2019. For handovers, the task is the
whole episode; a person is active while the wrist moves faster than `ACTIVE_SPEED`; a robot is active
while its hand link moves faster than `ACTIVE_SPEED` or its fingers faster than `ACTIVE_FINGER_SPEED`.
Smoothness is the spectral arc length of Balasubramanian et al., "On the analysis of movement
smoothness", Journal of NeuroEngineering and Rehabilitation 12:112, 2015. It does not depend on speed
and duration. The root mean square of the jerk depends on both; it is minimal in the minimum-jerk model
of human reaching (Flash and Hogan, Journal of Neuroscience 5(7), 1985). Positions are differentiated by
the filter of Savitzky and Golay, Analytical Chemistry 36(8), 1964.
"""

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.episode.callbacks import EpisodeTrace

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

ACTIVE_SPEED, ACTIVE_FINGER_SPEED = 0.05, 0.005  # m/s
_SMOOTHING_SAMPLES = 3  # speeds are averaged over 60 ms
_SHORTEST_PAUSE = 0.25  # s, shorter pauses do not divide an activity
# The third derivative of polynomials of this degree, fitted to this many samples (260 ms), has half power at 6.3 Hz:
# it keeps reaching movements and suppresses noise.
_JERK_DEGREE, _JERK_SAMPLES = 5, 13


@dataclass(frozen=True)
class FluencyMetrics:
    """Fluency, safety and effort of one episode.

    Attributes:
        handover_time: Time from the start of the episode to the release of the object (s); None
            without a release.
        human_idle: Share of the episode (0 to 1) in which the person does not move or is
            absent.
        robot_idle: Share of the episode (0 to 1) in which the robot does not move.
        concurrent: Share of the episode (0 to 1) in which person and robot both move.
        functional_delay: Time from the end of the person's last activity before the release to the
            start of the robot's last activity before the release, as share of the episode; negative
            if the robot starts earlier, None without a release.
        max_robot_object_force: Largest sum of the normal forces between robot and object in one physics
            step of 1 ms (N).
        min_distance: Smallest distance between robot and hand surfaces (m), sampled every 20 ms; 0
            after contact, None without a hand.
        giver_path: Length (m) of the path of the person's wrist, until the release or the end.
        giver_smoothness: Spectral arc length of the wrist's speed until the release or the end; at
            most 0, smoother if closer to 0; None if the wrist does not move.
        reach: Largest distance (m) of the wrist from its first position until the release or the
            end, a measure of how far a person has to reach.
        max_robot_hand_force: Largest sum of the normal forces between robot and human hand in one
            physics step of 1 ms (N); None without contact. By the official rules a contact ends the
            episode, so the value is the force of the first step.
        robot_hand_impulse: Sum over all physics steps of the normal forces between robot and human
            hand, times 1 ms (N s); None without contact.
        giver_jerk: Root mean square jerk of the person's wrist (m/s^3), until the release or the end;
            None if the hand is present for less than 260 ms.
        gripper_jerk: Root mean square jerk of the robot's hand link (m/s^3) in the whole episode; None
            in episodes shorter than 260 ms.
        gripper_path: Length (m) of the path of the robot's hand link.
        gripper_max_speed: Largest speed of the robot's hand link (m/s), averaged over 60 ms.
        gripper_mean_speed: Mean speed of the robot's hand link in the whole episode (m/s): path length
            by time.

    The last seven metrics are None for results of version 0.7 and of HandoverSim.
    """

    handover_time: float | None
    human_idle: float
    robot_idle: float
    concurrent: float
    functional_delay: float | None
    max_robot_object_force: float
    min_distance: float | None
    giver_path: float
    giver_smoothness: float | None
    reach: float
    max_robot_hand_force: float | None = None
    robot_hand_impulse: float | None = None
    giver_jerk: float | None = None
    gripper_jerk: float | None = None
    gripper_path: float | None = None
    gripper_max_speed: float | None = None
    gripper_mean_speed: float | None = None


def compute_fluency(trace: EpisodeTrace) -> FluencyMetrics:
    """Compute fluency, safety and effort of an episode from its motion trace."""
    person = compute_speeds(trace.wrist, trace.period) > ACTIVE_SPEED
    gripper_speeds = compute_speeds(trace.gripper, trace.period)
    robot = gripper_speeds > ACTIVE_SPEED
    robot |= compute_speeds(trace.fingers, trace.period) > ACTIVE_FINGER_SPEED
    release_step = trace.release_step
    end = trace.steps if release_step is None else release_step
    path = trace.wrist[: trace.count_samples_until(end)]
    path = path[~np.isnan(path[:, 0])]
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    gripper_path = float(np.linalg.norm(np.diff(trace.gripper, axis=0), axis=1).sum())
    return FluencyMetrics(
        handover_time=trace.release_time,
        human_idle=float(1.0 - person.mean()),
        robot_idle=float(1.0 - robot.mean()),
        concurrent=float((person & robot).mean()),
        functional_delay=None if release_step is None else _compute_delay(person, robot, trace, release_step),
        max_robot_object_force=trace.max_object_force,
        min_distance=trace.min_distance,
        giver_path=float(lengths.sum()),
        giver_smoothness=compute_spectral_arc_length(lengths, 1.0 / trace.period),
        reach=float(np.linalg.norm(path - path[0], axis=1).max()) if len(path) else 0.0,
        max_robot_hand_force=trace.max_hand_force,
        robot_hand_impulse=trace.hand_impulse,
        giver_jerk=compute_rms_jerk(path, trace.period),
        gripper_jerk=compute_rms_jerk(trace.gripper, trace.period),
        gripper_path=gripper_path,
        gripper_max_speed=float(gripper_speeds.max()),
        gripper_mean_speed=gripper_path / max((len(trace.gripper) - 1) * trace.period, trace.period),
    )


def compute_speeds(positions: Array, period: float) -> Array:
    """Compute (n,) speeds of (n, k) positions, averaged over 60 ms; 0 if a position is NaN.

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
    """Compute the root mean square of the jerk of a motion; None for fewer than 13 positions.

    The jerk is the third derivative of a polynomial of fifth degree, such as a minimum-jerk motion,
    fitted to 13 positions. The first and the last six positions have no such fit.

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
    """Compute the weights (13,) of equally spaced samples in the third derivative at the middle one."""
    offsets = np.arange(_JERK_SAMPLES) - _JERK_SAMPLES // 2
    weights: Array = 6.0 * np.linalg.pinv(np.vander(offsets, _JERK_DEGREE + 1, increasing=True))[3]
    return weights


def compute_spectral_arc_length(
    speed: Array, rate: float, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float | None:
    """Compute the spectral arc length of a speed profile: at most 0, closer to 0 if smoother.

    It is minus the length of the normalised amplitude spectrum; None if all speeds are zero.

    Args:
        speed: (n,) speeds at equal intervals.
        rate: Sampling rate (Hz).
        cutoff: Highest frequency of the spectrum (Hz).
        threshold: Share of the largest amplitude below which both ends of the spectrum are cut off.
        padding: The profile is padded with zeros to 2^padding times the next power of two.
    """
    if len(speed) == 0 or not np.any(speed):
        return None
    length = 2 ** (int(np.ceil(np.log2(len(speed)))) + padding)
    amplitude = np.abs(np.fft.rfft(speed, length))
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    amplitude = amplitude / amplitude.max()
    is_low = frequency <= cutoff
    amplitude, frequency = amplitude[is_low], frequency[is_low]
    large = np.flatnonzero(amplitude >= threshold)
    part = slice(large[0], large[-1] + 1)
    amplitude, frequency = amplitude[part], frequency[part]
    if len(frequency) < 2:
        return 0.0
    across = np.diff(frequency) / (frequency[-1] - frequency[0])
    return float(-np.sum(np.hypot(across, np.diff(amplitude))))


def find_activities(active: Flags, period: float) -> list[tuple[int, int]]:
    """Return first and last sample of each period of activity; pauses below 0.25 s do not split it.

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


def _compute_delay(person: Flags, robot: Flags, trace: EpisodeTrace, release_step: int) -> float | None:
    n = trace.count_samples_until(release_step)
    giving, taking = find_activities(person[:n], trace.period), find_activities(robot[:n], trace.period)
    if not giving or not taking:
        return None
    return float((taking[-1][0] - giving[-1][1]) * trace.period / trace.duration)
