import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.benchmarking.statistics import (
    mean_interval,
    paired_difference,
    rank_correlation,
    wilson_interval,
)


def test_wilson_against_known_values() -> None:
    # Newcombe (1998), Table I: 81/263 and 0/20.
    np.testing.assert_allclose(wilson_interval(81, 263), (0.2553, 0.3662), atol=5e-5)
    np.testing.assert_allclose(wilson_interval(0, 20), (0.0, 0.1611), atol=5e-5)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_the_rate(count_and_n: tuple[int, int]) -> None:
    count, n = count_and_n
    low, high = wilson_interval(count, n)
    assert 0.0 <= low <= count / n <= high <= 1.0
    assert low < high


def test_mean_interval() -> None:
    # Of the 27 resamples of three values one, more than 2.5 %, has the lowest mean and one the highest.
    assert mean_interval([1.0, 2.0, 3.0]) == (1.0, 3.0)
    assert mean_interval([2.0, 2.0]) == (2.0, 2.0)
    assert mean_interval([1.0]) is None
    assert mean_interval([]) is None


def test_mean_interval_of_many_values_is_the_usual_one() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    interval = mean_interval(values.tolist())
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    np.testing.assert_allclose(interval, (values.mean() - half, values.mean() + half), atol=0.1 * half)


@given(st.lists(st.floats(0.0, 1e6), min_size=2, max_size=30))
def test_mean_interval_lies_within_the_values_and_holds_their_mean(values: list[float]) -> None:
    interval = mean_interval(values)
    assert interval is not None
    low, high = interval
    slack = 1e-9 * max(values)
    assert min(values) - slack <= low <= high <= max(values) + slack
    assert low - slack <= np.mean(values) <= high + slack
    assert mean_interval(values) == interval, "the same values have the same interval"


def test_paired_differences_against_a_worked_example() -> None:
    """Agresti, Categorical Data Analysis: 150 of 1600 approved first and not later, 86 the other way round."""
    first = [True] * 794 + [True] * 150 + [False] * 86 + [False] * 570
    second = [True] * 794 + [False] * 150 + [True] * 86 + [False] * 570
    mean, low, high = paired_difference(first, second)
    assert mean == pytest.approx(0.04)
    assert (low, high) == (pytest.approx(0.021, abs=1e-3), pytest.approx(0.059, abs=1e-3))


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=200))
def test_paired_differences_hold_their_mean_and_turn_round(pairs: list[tuple[bool, bool]]) -> None:
    first, second = zip(*pairs, strict=True)
    mean, low, high = paired_difference(first, second)
    assert -1.0 <= low < high <= 1.0
    assert low - 1e-9 <= mean <= high + 1e-9
    assert paired_difference(second, first) == pytest.approx((-mean, -high, -low))


def test_paired_differences_need_pairs() -> None:
    with pytest.raises(ValueError, match="zip"):
        paired_difference([True], [True, False])
    with pytest.raises(ValueError, match="no pairs"):
        paired_difference([], [])


def test_rank_correlation_of_four_things() -> None:
    # Of the 24 orders of four things one has a rho of 1, and three more one of 0.8.
    alike = rank_correlation([1.0, 2.0, 3.0, 4.0], [10.0, 20.0, 30.0, 40.0])
    assert (alike.spearman, alike.kendall, alike.p) == pytest.approx((1.0, 1.0, 1 / 24))
    swapped = rank_correlation([1.0, 2.0, 3.0, 4.0], [10.0, 30.0, 20.0, 40.0])
    assert (swapped.spearman, swapped.kendall, swapped.p) == pytest.approx((0.8, 4 / 6, 4 / 24))
    assert swapped.least_p == alike.p
    assert rank_correlation([1.0, 2.0, 3.0], [3.0, 2.0, 1.0]).p == 1.0


@given(st.lists(st.integers(0, 5), min_size=3, max_size=6).filter(lambda values: len(set(values)) > 1))
def test_rank_correlation_with_ties_is_between_its_bounds(values: list[int]) -> None:
    found = rank_correlation(values, values)
    assert found.spearman == pytest.approx(1.0)
    assert found.p == found.least_p > 0.0


@pytest.mark.parametrize(("first", "second"), [([1, 2], [1, 2]), ([1, 2, 3], [1, 2]), ([1, 1, 1], [1, 2, 3])])
def test_rank_correlation_of_too_little(first: list[float], second: list[float]) -> None:
    with pytest.raises(ValueError, match="needed"):
        rank_correlation(first, second)
