"""95 % intervals for rates and means."""

from collections.abc import Sequence

import numpy as np
from scipy import stats


def wilson_interval(count: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate (0..1) seen `count` times in `n`."""
    interval = stats.binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Student's 95 % interval of a mean, or None for fewer than two values."""
    if len(values) < 2:
        return None
    half = float(stats.sem(values) * stats.t.ppf(0.975, len(values) - 1))
    mean = float(np.mean(values))
    return mean - half, mean + half


def paired_difference(first: Sequence[float], second: Sequence[float]) -> tuple[float, float, float]:
    """Mean of first less second, and Student's 95 % interval of it; pairs are made by position.

    Raises:
        ValueError: The two are not equally long.
    """
    differences = [float(one) - float(other) for one, other in zip(first, second, strict=True)]
    mean = float(np.mean(differences))
    low, high = mean_interval(differences) or (float("-inf"), float("inf"))
    return mean, low, high
