"""Scores of a policy with partners that it has not met, and their intervals by a bootstrap.

Arrays of scores have the axes policies (several trainings of one method), partners and scenes. The return J of a
policy with a partner is the mean score over scenes, here of average success. Best-response proximity is
J(policy, partner) / J(best, partner) (BR-Prox; Wang et al., "ZSC-Eval", NeurIPS 2024), where the best is the best
policy known for the partner.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

Array = npt.NDArray[np.float64]
#: Function from returns (..., policies, partners) and reference returns (..., partners) to numbers (...).
Statistic = Callable[[Array, Array], Array]

N_RESAMPLES = 2000
_TRIMMED = 0.25  # share of the values that an interquartile mean leaves out at each end


@dataclass(frozen=True)
class Estimate:
    """Value of a statistic with its 95 % interval.

    Attributes:
        value: Value for all policies, partners and scenes.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    value: float
    low: float
    high: float


def compute_interquartile_mean(values: npt.ArrayLike, n_axes: int = 1) -> Array:
    """Compute the mean of the middle half of the values over the last axes (Agarwal et al., NeurIPS 2021).

    Args:
        values: Values of any shape.
        n_axes: Number of last axes over whose values the mean is computed.
    """
    array = np.asarray(values, dtype=np.float64)
    flat = array.reshape(*array.shape[: array.ndim - n_axes], -1)
    return np.asarray(scipy.stats.trim_mean(flat, _TRIMMED, axis=-1), dtype=np.float64)


def compute_proximities(returns: Array, references: Array, clipped: bool = True) -> Array:
    """Compute best-response proximities (..., policies, partners).

    Args:
        returns: Returns (..., policies, partners).
        references: Returns (..., partners) of the best policy known for each partner.
        clipped: Whether proximities above 1 count as 1. They occur if a policy is better than the reference.

    Returns:
        Proximities; 1 for partners with whom no policy has a positive return.
    """
    best = np.broadcast_to(references[..., None, :], returns.shape)
    ratios = np.divide(returns, best, out=np.ones_like(returns), where=best > 0.0)
    return np.minimum(ratios, 1.0) if clipped else ratios


def compute_clipped_proximity(returns: Array, references: Array) -> Array:
    """Compute the interquartile mean of the clipped proximities over policies and partners."""
    return compute_interquartile_mean(compute_proximities(returns, references), n_axes=2)


def compute_unclipped_proximity(returns: Array, references: Array) -> Array:
    """Compute the interquartile mean of the unclipped proximities over policies and partners."""
    return compute_interquartile_mean(compute_proximities(returns, references, clipped=False), n_axes=2)


def compute_mean(returns: Array, references: Array) -> Array:
    """Compute the mean of the returns over policies and partners."""
    return np.asarray(returns.mean(axis=(-2, -1)), dtype=np.float64)


def compute_worst(returns: Array, references: Array) -> Array:
    """Compute the mean over policies of the return with the worst partner."""
    return np.asarray(returns.mean(axis=-2).min(axis=-1), dtype=np.float64)


def compute_largest(returns: Array, references: Array) -> Array:
    """Compute the mean over policies of the return with the partner for which it is largest."""
    return np.asarray(returns.mean(axis=-2).max(axis=-1), dtype=np.float64)


def compute_worst_proximity(returns: Array, references: Array) -> Array:
    """Compute the mean over policies of the unclipped proximity with the worst partner."""
    return compute_worst(compute_proximities(returns, references, clipped=False), references)


def estimate(
    statistic: Statistic, scores: Array, references: Array | None = None, resample_partners: bool = True
) -> Estimate:
    """Estimate a statistic with its bootstrap 95 % interval.

    Policies, partners and scenes are drawn with replacement. All policies and partners have the same scenes, so
    one draw of scenes applies to all of them (Owen, "The pigeonhole bootstrap", Annals of Applied Statistics 1(2),
    2007). The generator has a fixed seed: equal scores have equal intervals.

    Args:
        statistic: Function of returns and reference returns.
        scores: Scores (policies, partners, scenes).
        references: Scores (partners, scenes) of the best policy for each partner; default: zeros.
        resample_partners: Whether partners are drawn; otherwise they are fixed, as for the worst partner.
    """
    best = _check_references(scores, references)
    draws = _draw(scores.shape, resample_partners)
    values = statistic(_resample(scores, draws), _resample(best[None], draws.fix_policies())[:, 0])
    return _make_estimate(_compute(statistic, scores, best), values)


def estimate_difference(
    statistic: Statistic, first: Array, second: Array, references: Array | None = None, resample_partners: bool = True
) -> Estimate:
    """Estimate the difference of a statistic of two methods, first minus second, paired by partner and scene.

    Both methods get the same draws of partners and scenes; their policies are drawn separately.

    Args:
        statistic: Function of returns and reference returns.
        first: Scores (policies, partners, scenes) of the first method.
        second: Scores of the second method with the same partners and scenes; its number of policies may differ.
        references: Scores (partners, scenes) of the best policy for each partner; default: zeros.
        resample_partners: Whether partners are drawn.

    Raises:
        ValueError: Partners or scenes of the methods differ in number.
    """
    if first.shape[1:] != second.shape[1:]:
        raise ValueError(f"first and second must have the same partners and scenes, got {first.shape}, {second.shape}")
    best = _check_references(first, references)
    draws = _draw(first.shape, resample_partners)
    others = replace(draws, policies=np.random.default_rng(1).integers(len(second), size=(N_RESAMPLES, len(second))))
    means = _resample(best[None], draws.fix_policies())[:, 0]
    values = statistic(_resample(first, draws), means) - statistic(_resample(second, others), means)
    return _make_estimate(_compute(statistic, first, best) - _compute(statistic, second, best), values)


@dataclass(frozen=True, eq=False)
class _Draws:
    """Resamples of policies, partners and scenes.

    Attributes:
        policies: Indices (resamples, policies).
        partners: Indices (resamples, partners).
        scene_weights: Share (resamples, scenes) of every scene.
    """

    policies: npt.NDArray[np.int_]
    partners: npt.NDArray[np.int_]
    scene_weights: npt.NDArray[np.float64]

    def fix_policies(self) -> "_Draws":
        """Return the same draws of partners and scenes for a single policy."""
        return replace(self, policies=np.zeros((N_RESAMPLES, 1), dtype=int))


def _check_references(scores: Array, references: Array | None) -> Array:
    if scores.ndim != 3 or 0 in scores.shape:
        raise ValueError(f"scores must have the axes policies, partners and scenes, none empty, got {scores.shape}")
    best = np.zeros(scores.shape[1:]) if references is None else references
    if best.shape != scores.shape[1:]:
        raise ValueError(f"references must have shape {scores.shape[1:]}, got {best.shape}")
    return best


def _draw(shape: tuple[int, ...], resample_partners: bool) -> _Draws:
    rng = np.random.default_rng(0)
    policies, partners, scenes = (rng.integers(size, size=(N_RESAMPLES, size)) for size in shape)
    if not resample_partners:
        partners = np.tile(np.arange(shape[1]), (N_RESAMPLES, 1))
    weights = np.array([np.bincount(row, minlength=shape[2]) for row in scenes]) / shape[2]
    return _Draws(policies, partners, weights)


def _resample(scores: Array, draws: _Draws) -> Array:
    """Return the returns (resamples, policies, partners) of all resamples."""
    means = np.einsum("pks,rs->rpk", scores, draws.scene_weights)
    rows = np.arange(len(means))[:, None, None]
    chosen: Array = means[rows, draws.policies[:, :, None], draws.partners[:, None, :]]
    return chosen


def _compute(statistic: Statistic, scores: Array, references: Array) -> float:
    return float(statistic(scores.mean(axis=-1), references.mean(axis=-1)))


def _make_estimate(value: float, values: Array) -> Estimate:
    low, high = np.percentile(values, [2.5, 97.5])
    return Estimate(value, float(low), float(high))
