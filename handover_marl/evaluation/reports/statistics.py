"""Means, and 95 % intervals of rates, means and differences of rates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # loads scipy.stats, which takes a second, at its first use

_N_RESAMPLES = 2000


@dataclass(frozen=True)
class MeanEstimate:
    """Mean of a metric over episodes, with its confidence interval.

    Attributes:
        mean: Mean over the episodes that have a value; None if none has.
        interval_95: Bootstrap 95 % interval, or None for fewer than two values.
        n: Number of episodes that have a value.
    """

    mean: float | None
    interval_95: tuple[float, float] | None
    n: int


def estimate_mean(values: Sequence[float]) -> MeanEstimate:
    """Estimate a mean with its 95 % interval."""
    return MeanEstimate(float(np.mean(values)) if values else None, compute_mean_interval(values), len(values))


def compute_wilson_interval(count: int, n: int) -> tuple[float, float]:
    """Compute Wilson's 95 % interval of a rate (0..1).

    Args:
        count: Number of occurrences.
        n: Number of trials.
    """
    interval = scipy.stats.binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def compute_mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Compute the bootstrap 95 % interval of a mean (percentiles of 2,000 resamples).

    The interval lies within the range of the values, so that no share exceeds one and no force is
    negative. The generator has a fixed seed: equal values have equal intervals. The
    result is None for fewer than two values.
    """
    if len(values) < 2:
        return None
    data = np.asarray(values, dtype=np.float64)
    # scipy.stats.bootstrap draws the same resamples, but its percentiles are off by rounding errors.
    means = np.random.default_rng(0).choice(data, size=(_N_RESAMPLES, len(data))).mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def compute_paired_difference(first: Sequence[bool], second: Sequence[bool]) -> tuple[float, float, float]:
    """Compute the difference of two rates on the same scenes, first minus second (-1..1).

    The 95 % interval follows Agresti and Min (Statistics in Medicine 24, 2005): half an episode is
    added to each of the four kinds of pairs, so that the interval has a width even if few scenes,
    or none, differ.

    Returns:
        Difference, lower and upper end of its interval.

    Raises:
        ValueError: The sequences are empty or differ in length.
    """
    pairs = [(bool(one), bool(other)) for one, other in zip(first, second, strict=True)]
    if not pairs:
        raise ValueError("first and second must not be empty")
    gained = sum(one and not other for one, other in pairs)
    lost = sum(other and not one for one, other in pairs)
    n = len(pairs) + 2.0
    center = (gained - lost) / n
    half = scipy.stats.norm.ppf(0.975) * np.sqrt((gained + lost + 1.0) / n - center**2) / np.sqrt(n)
    low, high = max(-1.0, center - half), min(1.0, center + half)
    return (gained - lost) / len(pairs), float(low), float(high)
