"""Scores of a policy with unseen partners, and their 95 % intervals by a jackknife.

Arrays of scores have the axes policies (several trainings of one method), partners and scenes. The return of a policy
with a partner is the mean score over scenes.

An interval is a statistic plus and minus a standard error times a quantile of Student's distribution. The squared
standard error is the sum of the jackknife variances (Efron and Stein, Annals of Statistics 9(3), 1981) when policies,
families of partners and scenes are left out one at a time; its degrees of freedom are Satterthwaite's. The interval of
a rate is Wilson's with the same quantile, for the number of independent episodes that have this standard error (Korn
and Graubard, Survey Methodology 24(2), 1998). Percentiles of a bootstrap are too narrow for six families.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import scipy

from handover_marl.evaluation.reports.tables import Estimate

Array = npt.NDArray[np.float64]
#: Function from returns (policies, partners) to a number.
Statistic = Callable[[Array], float]


def compute_mean(returns: Array) -> float:
    """Compute the mean of returns (policies, partners) over both axes."""
    return float(returns.mean())


def compute_min_over_partners(returns: Array) -> float:
    """Average returns (policies, partners) over policies; return the smallest of the means."""
    return float(returns.mean(axis=0).min())


def compute_max_over_partners(returns: Array) -> float:
    """Average returns (policies, partners) over policies; return the largest of the means."""
    return float(returns.mean(axis=0).max())


def estimate(statistic: Statistic, scores: Array, families: Sequence[str] | None) -> Estimate:
    """Estimate a statistic of scores (policies, partners, scenes), 0 to 1, with a 95 % interval.

    The jackknife leaves out policies, scenes and families of partners one at a time, or partners if there is one
    family. `families` has the family of each partner; with None, no partner is left out, as for the worst partner.
    """
    return _estimate(lambda own: statistic(own.mean(axis=-1)), [scores], families, 0.0)


def estimate_rate(statistic: Statistic, flags: Array, families: Sequence[str] | None) -> Estimate:
    """Estimate a rate of outcomes (policies, partners, scenes), 0 or 1, with an interval as wide as Wilson's or wider.

    Families are as in `estimate`; None is for the rate with one of the partners, e.g. the worst.
    """
    value, error, quantile = _apply_jackknife(lambda own: statistic(own.mean(axis=-1)), [flags], families)
    n = flags.size if families is not None else flags.size // flags.shape[1]
    weight = quantile**2 / (min(n, value * (1.0 - value) / error**2) if error else n)
    center = (value + weight / 2.0) / (1.0 + weight)
    half = np.sqrt(weight * value * (1.0 - value) + weight**2 / 4.0) / (1.0 + weight)
    return Estimate(value, (max(0.0, float(center - half)), min(1.0, float(center + half))), n)


def estimate_difference(statistic: Statistic, first: Array, second: Array, families: Sequence[str] | None) -> Estimate:
    """Estimate the difference of a statistic of two methods, first minus second, paired by partner and scene.

    The numbers of policies may differ. Arguments are as in `estimate`.
    """

    def compute(one: Array, other: Array) -> float:
        return statistic(one.mean(axis=-1)) - statistic(other.mean(axis=-1))

    return _estimate(compute, [first, second], families, -1.0)


def _estimate(
    compute: Callable[..., float], methods: list[Array], families: Sequence[str] | None, lowest: float
) -> Estimate:
    """Estimate a function `compute` of methods' scores with a 95 % interval within `lowest` and 1; see `estimate`."""
    value, error, quantile = _apply_jackknife(compute, methods, families)
    low, high = value - quantile * error, value + quantile * error
    return Estimate(value, (max(lowest, low), min(1.0, high)), methods[0].size)


def _apply_jackknife(
    compute: Callable[..., float], methods: list[Array], families: Sequence[str] | None
) -> tuple[float, float, float]:
    """Return the value of `compute` for the methods' scores, its standard error, and Student's 97.5 % quantile."""
    shape = methods[0].shape
    everywhere = range(len(methods))
    # Which arrays vary together, along which axis, and the index sets that are left out one at a time.
    variations: list[tuple[Sequence[int], int, list[list[int]]]] = [(everywhere, 2, _group(range(shape[2])))]
    variations += [([number], 0, _group(range(len(method)))) for number, method in enumerate(methods)]
    if families is not None:
        variations.append((everywhere, 1, _group(families if len(set(families)) > 1 else range(shape[1]))))
    variances, freedoms = [], []
    for chosen, axis, groups in variations:
        if len(groups) > 1:
            values = [
                compute(*(np.delete(each, group, axis) if n in chosen else each for n, each in enumerate(methods)))
                for group in groups
            ]
            freedoms.append(len(groups) - 1)
            variances.append(freedoms[-1] * np.var(values))
    variance = np.array(variances)
    freedom = variance.sum() ** 2 / (variance**2 / freedoms).sum() if variance.any() else np.inf
    return compute(*methods), float(np.sqrt(variance.sum())), float(scipy.stats.t.ppf(0.975, freedom))


def _group(labels: Sequence[object]) -> list[list[int]]:
    """Return one list for each different label: the indices of its entries."""
    return [[n for n, label in enumerate(labels) if label == one] for one in dict.fromkeys(labels)]
