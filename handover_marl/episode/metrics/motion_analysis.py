"""Quantities of sampled motion: speeds, activities, jerk, smoothness and protective distances."""

import functools

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_SMOOTHING_SAMPLES = 3  # speeds are averaged over 60 ms
_SHORTEST_PAUSE = 0.25  # s, shorter pauses do not divide an activity
# The third derivative of polynomials of this degree, fitted to this many samples (260 ms), has half power at 6.3 Hz:
# it keeps reaching movements and suppresses noise.
_JERK_DEGREE, _JERK_SAMPLES = 5, 13
#: Time from the detection of a person to the start of the robot's braking (s), as assumed for protective distances.
REACTION_TIME = 0.1
#: Deceleration of the gripper while the robot brakes (m/s^2): the limit of the Panda's translational acceleration
#: in the interface specification of Franka Robotics.
BRAKING_DECELERATION = 13.0


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


def compute_protective_distances(person_speeds: Array, robot_speeds: Array) -> Array:
    """Compute the protective separation distances (n,) of person and robot (m) by ISO/TS 15066:2016, 5.5.4.

    The distance is the sum of the paths of the person until the robot stands still, of the robot until it starts
    to brake, and of the robot while it brakes with constant deceleration. Both are assumed to move towards each
    other. The intrusion distance and the position uncertainties of the standard are zero in simulation.

    Args:
        person_speeds: (n,) speeds of the person (m/s).
        robot_speeds: (n,) speeds of the robot (m/s).
    """
    braking_time = robot_speeds / BRAKING_DECELERATION
    person = person_speeds * (REACTION_TIME + braking_time)
    distances: Array = person + robot_speeds * REACTION_TIME + 0.5 * robot_speeds * braking_time
    return distances
