"""Scores of a policy with unseen partners, and their 95 % intervals by a jackknife.

Arrays of scores have the axes policies (several trainings of one method), partners and scenes. The return J of a
policy with a partner is the mean score over scenes, here of average success. Best-response proximity is
J(policy, partner) / J(best, partner) (BR-Prox; Wang et al., "ZSC-Eval", NeurIPS 2024), where the best is the best
policy known for the partner.

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
#: Function from returns (policies, partners), and those of the best policies (partners,), to a number.
Statistic = Callable[[Array, Array], float]

_TRIMMED = 0.25  # share of the values that an interquartile mean leaves out at each end


def compute_proximities(returns: Array, references: Array) -> Array:
    """Divide returns (policies, partners) by the best known policies' returns (partners,): best-response proximities.

    A proximity is above 1 where a policy exceeds the best one, and 1 where the best policy's return is not positive.
    """
    return np.divide(returns, references, out=np.ones_like(returns), where=references > 0.0)


def compute_proximity(returns: Array, references: Array) -> float:
    """Compute the interquartile mean of `compute_proximities` over both axes (Agarwal et al., NeurIPS 2021)."""
    return float(scipy.stats.trim_mean(compute_proximities(returns, references), _TRIMMED, axis=None))


def compute_mean(returns: Array, references: Array) -> float:
    """Compute the mean of returns (policies, partners) over both axes; ignore `references`."""
    return float(returns.mean())


def compute_min_over_partners(returns: Array, references: Array) -> float:
    """Average returns (policies, partners) over policies; return the smallest of the means; ignore `references`."""
    return float(returns.mean(axis=0).min())


def compute_max_over_partners(returns: Array, references: Array) -> float:
    """Average returns (policies, partners) over policies; return the largest of the means; ignore `references`."""
    return float(returns.mean(axis=0).max())


def compute_worst_proximity(returns: Array, references: Array) -> float:
    """Average `compute_proximities` (policies, partners) over policies; return the smallest of the partners' means."""
    return compute_min_over_partners(compute_proximities(returns, references), references)


def estimate(
    statistic: Statistic, scores: Array, families: Sequence[str] | None, references: Array | None = None
) -> Estimate:
    """Estimate a statistic with a 95 % interval that covers the variation of policies, families and scenes.

    Args:
        statistic: Function of returns (policies, partners) and reference returns (partners,); see `Statistic`.
        scores: Scores (policies, partners, scenes) from 0 to 1.
        families: Family of every partner; the jackknife leaves out a family at a time, or a partner if there is one
            family. None leaves out none, as for the worst partner.
        references: Scores (partners, scenes) of the best policy for each partner; None if the statistic needs none.
    """

    def compute(own: Array, best: Array) -> float:
        return statistic(own.mean(axis=-1), best[0].mean(axis=-1))

    return _estimate(compute, [scores], families, references, 0.0)


def estimate_rate(statistic: Statistic, flags: Array, families: Sequence[str] | None) -> Estimate:
    """Estimate a rate with a 95 % interval that is at least as wide as Wilson's interval for the number of episodes.

    Args:
        statistic: Function of returns (policies, partners), which are here shares of scenes; see `Statistic`.
        flags: Outcomes (policies, partners, scenes), 0 or 1.
        families: Family of every partner, of which the jackknife leaves out one at a time; None for the rate with one
            of the partners, e.g. the worst.
    """
    value, error, quantile = _apply_jackknife(lambda own, _: statistic(own.mean(axis=-1), own), [flags], families, None)
    n = flags.size if families is not None else flags.size // flags.shape[1]
    weight = quantile**2 / (min(n, value * (1.0 - value) / error**2) if error else n)
    center = (value + weight / 2.0) / (1.0 + weight)
    half = np.sqrt(weight * value * (1.0 - value) + weight**2 / 4.0) / (1.0 + weight)
    return Estimate(value, (max(0.0, float(center - half)), min(1.0, float(center + half))), n)


def estimate_difference(
    statistic: Statistic, first: Array, second: Array, families: Sequence[str] | None, references: Array | None = None
) -> Estimate:
    """Estimate the difference of a statistic of two methods, first minus second, paired by partner and scene.

    Args:
        statistic: Function of returns (policies, partners) and reference returns (partners,); see `Statistic`.
        first: Scores (policies, partners, scenes) of the first method.
        second: Scores of the second method with the same partners and scenes; its number of policies may differ.
        families: Family of every partner, of which the jackknife leaves out one at a time; None leaves out none.
        references: Scores (partners, scenes) of the best policy for each partner; None if the statistic needs none.
    """

    def compute(one: Array, other: Array, best: Array) -> float:
        returns = best[0].mean(axis=-1)
        return statistic(one.mean(axis=-1), returns) - statistic(other.mean(axis=-1), returns)

    return _estimate(compute, [first, second], families, references, -1.0 if references is None else -np.inf)


def _estimate(
    compute: Callable[..., float],
    methods: list[Array],
    families: Sequence[str] | None,
    references: Array | None,
    lowest: float,
) -> Estimate:
    """Estimate a function of methods' scores and the references; its 95 % interval ends at `lowest` or above."""
    value, error, quantile = _apply_jackknife(compute, methods, families, references)
    low, high = value - quantile * error, value + quantile * error
    return Estimate(value, (max(lowest, low), min(1.0 if references is None else np.inf, high)), methods[0].size)


def _apply_jackknife(
    compute: Callable[..., float], methods: list[Array], families: Sequence[str] | None, references: Array | None
) -> tuple[float, float, float]:
    """Return the value of a function of methods' scores and references, its standard error, and Student's quantile."""
    shape = methods[0].shape
    arrays = [*methods, np.zeros((1, *shape[1:])) if references is None else references[None]]
    everywhere = range(len(arrays))
    # Which arrays vary together, along which axis, and the index sets that are left out one at a time.
    variations: list[tuple[Sequence[int], int, list[list[int]]]] = [(everywhere, 2, _group(range(shape[2])))]
    variations += [([number], 0, _group(range(len(method)))) for number, method in enumerate(methods)]
    if families is not None:
        variations.append((everywhere, 1, _group(families if len(set(families)) > 1 else range(shape[1]))))
    variances, freedoms = [], []
    for chosen, axis, groups in variations:
        if len(groups) > 1:
            values = [
                compute(*(np.delete(each, group, axis) if n in chosen else each for n, each in enumerate(arrays)))
                for group in groups
            ]
            freedoms.append(len(groups) - 1)
            variances.append(freedoms[-1] * np.var(values))
    variance = np.array(variances)
    freedom = variance.sum() ** 2 / (variance**2 / freedoms).sum() if variance.any() else np.inf
    return compute(*arrays), float(np.sqrt(variance.sum())), float(scipy.stats.t.ppf(0.975, freedom))


def _group(labels: Sequence[object]) -> list[list[int]]:
    """Return one list for each different label: the indices of its entries."""
    return [[n for n, label in enumerate(labels) if label == one] for one in dict.fromkeys(labels)]
