"""Tests of scores and of their intervals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.evaluation.strangers.scores import (
    compute_clipped_proximity,
    compute_interquartile_mean,
    compute_largest,
    compute_mean,
    compute_proximities,
    compute_unclipped_proximity,
    compute_worst,
    estimate,
    estimate_difference,
)

SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 5), st.integers(1, 6))


@st.composite
def scores_and_references(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    shape, seed = draw(SHAPES), draw(st.integers(0, 1000))
    rng = np.random.default_rng(seed)
    scores = rng.random(shape) * (rng.random(shape) < 0.8)
    return scores, np.maximum(rng.random(shape[1:]), 0.05)


@given(scores_and_references())
def test_clipped_proximities_are_shares(pair: tuple[np.ndarray, np.ndarray]) -> None:
    returns, references = pair[0].mean(axis=-1), pair[1].mean(axis=-1)
    clipped, unclipped = (compute_proximities(returns, references, clipped=flag) for flag in (True, False))
    assert (clipped >= 0.0).all()
    assert (clipped <= 1.0).all()
    np.testing.assert_array_equal(clipped, np.minimum(unclipped, 1.0))
    assert compute_clipped_proximity(returns, references) <= compute_unclipped_proximity(returns, references) + 1e-12


@given(scores_and_references())
def test_the_best_policy_has_proximity_one(pair: tuple[np.ndarray, np.ndarray]) -> None:
    best = pair[0][:1]
    np.testing.assert_allclose(compute_proximities(best.mean(axis=-1), best[0].mean(axis=-1)), 1.0)


def test_partners_with_whom_nothing_succeeds_count_as_reached() -> None:
    returns, references = np.array([[0.0, 0.3]]), np.array([0.0, 0.6])
    np.testing.assert_array_equal(compute_proximities(returns, references), [[1.0, 0.5]])


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_interquartile_means_lie_between_the_quartiles(values: list[float]) -> None:
    found = compute_interquartile_mean(values)
    assert min(values) - 1e-12 <= found <= max(values) + 1e-12
    assert compute_interquartile_mean(values[::-1]) == pytest.approx(found)


def test_interquartile_means_ignore_the_ends() -> None:
    assert compute_interquartile_mean([-100.0, 1.0, 2.0, 100.0]) == 1.5


@settings(max_examples=10, deadline=None)
@given(scores_and_references())
def test_intervals_contain_the_mean_and_repeat(pair: tuple[np.ndarray, np.ndarray]) -> None:
    scores, references = pair
    found = estimate(compute_mean, scores, references)
    assert found == estimate(compute_mean, scores, references)
    assert found.value == pytest.approx(scores.mean())
    assert found.low - 1e-9 <= found.value <= found.high + 1e-9
    assert scores.min() - 1e-9 <= found.low
    assert found.high <= scores.max() + 1e-9


@settings(max_examples=10, deadline=None)
@given(scores_and_references())
def test_worst_and_largest_bound_the_mean(pair: tuple[np.ndarray, np.ndarray]) -> None:
    scores, _ = pair
    values = [estimate(each, scores, None, False).value for each in (compute_worst, compute_mean, compute_largest)]
    assert values == sorted(values)


def test_intervals_cover_the_variation_between_trainings() -> None:
    """Three trainings with very different scores have a wide interval, however many scenes there are."""
    scores = np.array([0.1, 0.5, 0.9])[:, None, None] * np.ones((3, 4, 500))
    assert estimate(compute_mean, scores).high - estimate(compute_mean, scores).low > 0.4
    same = np.full((3, 4, 500), 0.5)
    assert (estimate(compute_mean, same).low, estimate(compute_mean, same).high) == pytest.approx((0.5, 0.5))


def test_fixed_partners_add_no_variation() -> None:
    scores = np.array([0.1, 0.5, 0.9])[None, :, None] * np.ones((1, 3, 50))
    found = estimate(compute_mean, scores, resample_partners=False)
    assert found.low == pytest.approx(found.high)
    assert estimate(compute_mean, scores).high > 0.6


@settings(max_examples=10, deadline=None)
@given(scores_and_references())
def test_a_method_does_not_differ_from_itself(pair: tuple[np.ndarray, np.ndarray]) -> None:
    scores, references = pair[0][:1], pair[1]
    found = estimate_difference(compute_unclipped_proximity, scores, scores, references)
    assert (found.value, found.low, found.high) == (0.0, 0.0, 0.0)


def test_differences_are_paired_by_scene() -> None:
    """A constant gain in scenes of very different difficulty has a narrow interval."""
    rng = np.random.default_rng(0)
    first = np.round(rng.random((1, 4, 30)), 3)
    found = estimate_difference(compute_mean, first + 0.1, first)
    assert found.value == pytest.approx(0.1)
    assert found.high - found.low < 1e-9
    opposite = estimate_difference(compute_mean, first, first + 0.1)
    assert (opposite.value, opposite.low) == pytest.approx((-found.value, -found.high))


def test_wrong_shapes_are_refused() -> None:
    scores = np.ones((2, 3, 4))
    with pytest.raises(ValueError, match="same partners and scenes"):
        estimate_difference(compute_mean, scores, scores[:, :2])
    with pytest.raises(ValueError, match=r"references must have shape \(3, 4\)"):
        estimate(compute_mean, scores, np.ones((3, 5)))
    with pytest.raises(ValueError, match="none empty"):
        estimate(compute_mean, np.ones((2, 0, 4)))
