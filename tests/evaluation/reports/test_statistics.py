import numpy as np
import pytest

from handover_marl.evaluation.reports.tables import (
    compute_mean_interval,
    compute_paired_difference,
    compute_wilson_interval,
)


def test_wilson_against_known_values() -> None:
    # Newcombe (1998), Table I: 81/263 and 0/20.
    np.testing.assert_allclose(compute_wilson_interval(81, 263), (0.2553, 0.3662), atol=5e-5)
    np.testing.assert_allclose(compute_wilson_interval(0, 20), (0.0, 0.1611), atol=5e-5)


def test_mean_interval() -> None:
    # One of the 27 resamples of three values has the lowest mean and one the highest; 1/27 is more than 2.5 %.
    assert compute_mean_interval([1.0, 2.0, 3.0]) == (1.0, 3.0)
    assert compute_mean_interval([2.0, 2.0]) == (2.0, 2.0)
    assert compute_mean_interval([1.0]) is None
    assert compute_mean_interval([]) is None


def test_mean_intervals_are_those_of_two_thousand_resamples() -> None:
    """The 2000 resamples are fixed, so that later versions reproduce the intervals of the results pages."""
    values = np.random.default_rng(2).normal(5.0, 2.0, 25)
    resamples = np.random.default_rng(0).integers(0, 25, (2000, 25))
    expected = np.percentile(values[resamples].mean(axis=1), [2.5, 97.5])
    np.testing.assert_allclose(compute_mean_interval(values.tolist()), expected, rtol=1e-12)


def test_paired_differences_against_a_worked_example() -> None:
    """The interval is that of Agresti, Categorical Data Analysis: 150 of 1600 approved only first, 86 only later."""
    first = [True] * 794 + [True] * 150 + [False] * 86 + [False] * 570
    second = [True] * 794 + [False] * 150 + [True] * 86 + [False] * 570
    mean, low, high = compute_paired_difference(first, second)
    assert mean == pytest.approx(0.04)
    assert (low, high) == (pytest.approx(0.021, abs=1e-3), pytest.approx(0.059, abs=1e-3))


def test_paired_differences_of_few_scenes_add_half_an_episode_to_each_kind_of_pair() -> None:
    """Count 4 of 10 scenes that only the first solves, and 1 that only the second solves, as 4.5 and 1.5 of 12."""
    first = [True] * 4 + [False] + [True] * 5
    second = [False] * 4 + [True] + [True] * 5
    mean, low, high = compute_paired_difference(first, second)
    half = 1.959964 * (((4.5 + 1.5) / 12 - (3 / 12) ** 2) / 12) ** 0.5
    assert (mean, low, high) == pytest.approx((0.3, 0.25 - half, 0.25 + half), abs=1e-5)
