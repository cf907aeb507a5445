"""Metrics of how a handover went beside the official ones: fluency, safety and effort.

Idle times, concurrent activity and functional delay after Hoffman, "Evaluating Fluency in Human-Robot
Collaboration", IEEE Transactions on Human-Machine Systems 49(3), 2019, with these readings for handovers: the task
is the whole episode; a person is active while the wrist moves faster than `ACTIVE_SPEED`, a robot while its hand
link does or its fingers move faster than `ACTIVE_FINGERS`. Smoothness is the spectral arc length of
Balasubramanian et al., "On the analysis of movement smoothness", Journal of NeuroEngineering and
Rehabilitation 12:112, 2015.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.episode.track import Track

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

ACTIVE_SPEED, ACTIVE_FINGERS = 0.05, 0.005  # m/s
# Speeds are averaged over so many samples (60 ms); shorter pauses than this (s) do not divide an activity.
_SMOOTHED, _PAUSE = 3, 0.25


@dataclass(frozen=True)
class Fluency:
    """One episode's metrics.

    Attributes:
        handover_time: From the start until the person lets go (s), or None.
        human_idle: Share of the episode in which the person does not move (0..1); nor does one who is not there.
        robot_idle: Share in which the robot does not move.
        concurrent: Share in which both move.
        functional_delay: From the end of the person's last activity before letting go to the start of the activity
            in which the robot takes the object, as share of the episode; negative when the robot starts earlier.
            None without a release.
        peak_force: Largest sum of normal forces between robot and object in one physics step (N).
        min_distance: Smallest distance of robot and hand surfaces (m), every 20 ms; 0 when they touched, None
            without a hand.
        giver_path: Way of the wrist (m), until the person lets go or to the end.
        giver_smoothness: Spectral arc length of that way; at most 0, smoother when nearer to it. None if it never
            moves.
        reach: Farthest that the wrist was from where it first appeared until then (m), a stand-in for how far a
            person has to stretch.
    """

    handover_time: float | None
    human_idle: float
    robot_idle: float
    concurrent: float
    functional_delay: float | None
    peak_force: float
    min_distance: float | None
    giver_path: float
    giver_smoothness: float | None
    reach: float


def fluency(track: Track) -> Fluency:
    """The metrics of an episode."""
    person = speeds(track.wrist, track.period) > ACTIVE_SPEED
    robot = speeds(track.gripper, track.period) > ACTIVE_SPEED
    robot |= speeds(track.fingers, track.period) > ACTIVE_FINGERS
    end = track.steps if track.release_step is None else track.release_step
    way = track.wrist[: track.samples_until(end)]
    way = way[~np.isnan(way[:, 0])]
    return Fluency(
        handover_time=track.release,
        human_idle=float(1.0 - person.mean()),
        robot_idle=float(1.0 - robot.mean()),
        concurrent=float((person & robot).mean()),
        functional_delay=None if track.release_step is None else _delay(person, robot, track, track.release_step),
        peak_force=track.peak_force,
        min_distance=track.gap,
        giver_path=float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()),
        giver_smoothness=spectral_arc_length(np.linalg.norm(np.diff(way, axis=0), axis=1), 1.0 / track.period),
        reach=float(np.linalg.norm(way - way[0], axis=1).max()) if len(way) else 0.0,
    )


def speeds(places: Array, period: float) -> Array:
    """(n,) speeds of (n, k) places, averaged over 60 ms; 0 where a place is not known."""
    if len(places) < 2:
        return np.zeros(len(places))
    speed = np.linalg.norm(np.gradient(places, period, axis=0), axis=1)
    speed = np.nan_to_num(speed, nan=0.0)
    padded = np.pad(speed, _SMOOTHED // 2, mode="edge")
    return np.convolve(padded, np.full(_SMOOTHED, 1.0 / _SMOOTHED), mode="valid")


def spectral_arc_length(
    speed: Array, rate: float, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float | None:
    """Minus the length of the normalised amplitude spectrum of a speed profile.

    Args:
        speed: (n,) at equal times.
        rate: Samples a second (Hz).
        cutoff: Highest frequency that counts (Hz).
        threshold: Share of the greatest amplitude below which the spectrum's end does not count.
        padding: The profile is padded with zeros to 2^padding times the next power of two.
    """
    if len(speed) == 0 or not np.any(speed):
        return None
    length = 2 ** (int(np.ceil(np.log2(len(speed)))) + padding)
    amplitude = np.abs(np.fft.rfft(speed, length))
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    amplitude = amplitude / amplitude.max()
    inside = frequency <= cutoff
    amplitude, frequency = amplitude[inside], frequency[inside]
    counted = np.flatnonzero(amplitude >= threshold)
    part = slice(counted[0], counted[-1] + 1)
    amplitude, frequency = amplitude[part], frequency[part]
    if len(frequency) < 2:
        return 0.0
    across = np.diff(frequency) / (frequency[-1] - frequency[0])
    return float(-np.sum(np.hypot(across, np.diff(amplitude))))


def _delay(person: Flags, robot: Flags, track: Track, release_step: int) -> float | None:
    n = track.samples_until(release_step)
    gave, took = activities(person[:n], track.period), activities(robot[:n], track.period)
    if not gave or not took:
        return None
    return float((took[-1][0] - gave[-1][1]) * track.period / track.duration)


def activities(active: Flags, period: float) -> list[tuple[int, int]]:
    """First and last sample of every activity; pauses shorter than a quarter of a second do not divide one."""
    runs: list[tuple[int, int]] = []
    for sample in np.flatnonzero(active).tolist():
        if runs and (sample - runs[-1][1]) * period <= _PAUSE:
            runs[-1] = (runs[-1][0], sample)
        else:
            runs.append((sample, sample))
    return runs
