"""95 % intervals for rates and means, and how far two rankings agree."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

_RESAMPLES = 2000


def wilson_interval(count: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate (0..1) seen `count` times in `n`."""
    interval = stats.binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Bootstrap 95 % interval of a mean (percentiles of 2,000 resamples), or None for fewer than two values.

    It lies within the values seen, so that no share exceeds one and no force is negative. Seeded: the same values have
    the same interval.
    """
    if len(values) < 2:
        return None
    data = np.asarray(values, dtype=np.float64)
    rng = np.random.default_rng(0)
    means = rng.choice(data, size=(_RESAMPLES, len(data))).mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def paired_difference(first: Sequence[bool], second: Sequence[bool]) -> tuple[float, float, float]:
    """Difference of two rates seen on the same scenes, first less second, and its 95 % interval (-1..1).

    The interval is Agresti and Min's (Statistics in Medicine 24, 2005): half an episode is added to each of the
    four kinds of pairs, so that it is no point when few scenes, or none, came out differently.

    Raises:
        ValueError: The two are not equally long, or empty.
    """
    pairs = [(bool(one), bool(other)) for one, other in zip(first, second, strict=True)]
    if not pairs:
        raise ValueError("no pairs")
    gained = sum(one and not other for one, other in pairs)
    lost = sum(other and not one for one, other in pairs)
    n = len(pairs) + 2.0
    middle = (gained - lost) / n
    half = stats.norm.ppf(0.975) * np.sqrt((gained + lost + 1.0) / n - middle**2) / np.sqrt(n)
    low, high = max(-1.0, middle - half), min(1.0, middle + half)
    return (gained - lost) / len(pairs), float(low), float(high)


@dataclass(frozen=True)
class RankCorrelation:
    """How far two measurements of the same things rank them alike.

    Attributes:
        n: How many things.
        spearman: Spearman's rho (-1..1).
        kendall: Kendall's tau-b (-1..1).
        p: Share of all orders of the second that agree with the first as well or better, by Spearman's rho (0..1).
        least_p: That share if they agreed perfectly: no smaller one can be had from so few things.
    """

    n: int
    spearman: float
    kendall: float
    p: float
    least_p: float


_MOST_RANKED = 9


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> RankCorrelation:
    """Rank correlations of two measurements of the same things, with an exact one-sided permutation test.

    Raises:
        ValueError: They are not equally long, fewer than three or more than nine, or one of them is all ties.
    """
    n = len(first)
    if n != len(second) or not 3 <= n <= _MOST_RANKED or len(set(first)) == 1 or len(set(second)) == 1:
        raise ValueError(
            f"ranks of {n} and {len(second)} things: three to {_MOST_RANKED} of both, not all tied, needed"
        )
    ranks = stats.rankdata(first), stats.rankdata(second)
    orders = np.array(list(itertools.permutations(ranks[1])))
    agreements = (orders - orders.mean()) @ (ranks[0] - ranks[0].mean())
    here = float((ranks[1] - ranks[1].mean()) @ (ranks[0] - ranks[0].mean()))
    return RankCorrelation(
        n,
        float(stats.spearmanr(first, second).statistic),
        float(stats.kendalltau(first, second).statistic),
        float(np.mean(agreements > here - 1e-9)),
        float(np.mean(agreements > agreements.max() - 1e-9)),
    )
