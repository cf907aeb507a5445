"""Tests of scores and of their intervals."""

import numpy as np
import pytest
import scipy.stats

from handover_marl.evaluation.reports.tables import compute_wilson_interval, estimate_paired_difference
from handover_marl.evaluation.strangers.report import estimate_mean_score, estimate_partner_rate


@pytest.mark.slow
@pytest.mark.parametrize(("varying", "kind"), [("families", "mean"), ("scenes", "mean"), ("families", "rate")])
def test_intervals_cover_whatever_varies(varying: str, kind: str) -> None:
    """At least 91 % of 200 intervals contain the value that the simulated evaluations have on average.

    With six families of three partners and 36 scenes; 91 % are 2.6 standard errors less than 95 %.
    """
    rng = np.random.default_rng(0)
    families = [str(number // 3) for number in range(18)]
    covered = []
    for _ in range(200):
        effect = {"families": np.repeat(rng.normal(size=6), 3)[:, None], "scenes": rng.normal(size=(1, 36))}[varying]
        if kind == "rate":
            chances = 1.0 / (1.0 + np.exp(-3.0 - effect))
            found = estimate_partner_rate(np.mean, (rng.random((1, 18, 36)) < chances).astype(float), families)
        else:
            found = estimate_mean_score(0.5 + 0.1 * effect + 0.05 * rng.normal(size=(1, 18, 36)), families)
        assert found.interval_95 is not None
        # A standard normal effect changes the logit 3 to a mean rate of 0.931.
        covered.append(found.interval_95[0] <= (0.931 if kind == "rate" else 0.5) <= found.interval_95[1])
    assert np.mean(covered) >= 0.91


def test_the_worst_partner_is_that_of_the_mean_over_policies_and_scenes() -> None:
    scores = np.array([[[1.0, 0.2], [0.0, 0.2]], [[0.6, 1.0], [0.6, 0.8]]])
    assert estimate_partner_rate(np.min, scores, None).mean == pytest.approx(0.4)
    assert estimate_partner_rate(np.max, scores, None).mean == pytest.approx(0.7)


@pytest.mark.parametrize("count", [0, 12])
def test_rates_with_a_single_partner_have_wilson_intervals_of_its_episodes(count: int) -> None:
    flags = np.full((1, 18, 12), count / 12)
    found = estimate_partner_rate(np.min, flags, None)
    assert found.interval_95 == pytest.approx(compute_wilson_interval(count, 12), abs=1e-12)
    found = estimate_partner_rate(np.mean, flags, ["a"] * 9 + ["b"] * 9)
    assert found.interval_95 == pytest.approx(compute_wilson_interval(count * 18, 216), abs=1e-12)
    found = estimate_partner_rate(np.mean, np.ones((1, 1, 13)), None)
    assert found.interval_95 is not None
    assert found.interval_95[1] == 1.0, "rounding does not lead beyond 1"


def measure_width(scores: np.ndarray, families: list[str] | None) -> float:
    found = estimate_mean_score(scores, families)
    assert found.interval_95 is not None
    return found.interval_95[1] - found.interval_95[0]


def test_intervals_cover_trainings_and_partners_unless_they_are_fixed() -> None:
    """Three trainings with very different scores have a wide interval, however many scenes there are."""
    values = np.array([0.1, 0.5, 0.9])
    scores = values[:, None, None] * np.ones((3, 4, 500))
    assert measure_width(scores, ["a", "a", "b", "b"]) > 0.4
    assert measure_width(np.full((3, 4, 500), 0.5), ["a", "a", "b", "b"]) == pytest.approx(0.0)
    scores = values[None, :, None] * np.ones((1, 3, 50))
    assert measure_width(scores, None) == pytest.approx(0.0)
    # Partners of a single family vary one by one.
    assert measure_width(scores, ["a", "a", "a"]) == measure_width(scores, ["a", "b", "c"]) > 0.5
    # Means 0.5 and 0.51 of two families have a standard error of half their difference, and one degree of freedom.
    scores = np.repeat([0.49, 0.51, 0.51], [1, 1, 2])[None, :, None] * np.ones((1, 4, 50))
    assert measure_width(scores, ["a", "a", "b", "b"]) == pytest.approx(2 * 0.005 * scipy.stats.t.ppf(0.975, 1))


def test_differences_are_paired_by_scene() -> None:
    """A constant gain in scenes of very different difficulty has a narrow interval."""
    first = np.round(np.random.default_rng(0).random((1, 4, 30)), 3)
    found = estimate_mean_score(first + 0.1, ["a", "a", "b", "b"], first)
    assert found.mean == pytest.approx(0.1)
    assert found.interval_95 == pytest.approx((0.1, 0.1), abs=0.02)


def test_equal_methods_have_an_interval_of_their_difference() -> None:
    flags = np.ones((1, 1, 36))
    found = estimate_mean_score(flags, ["a"], flags).interval_95
    assert found == pytest.approx(estimate_paired_difference([True] * 36, [True] * 36).interval_95, abs=0.01)
    assert estimate_mean_score(np.ones((1, 1, 1)), ["a"]).interval_95 is None


def test_intervals_of_a_single_partner_are_those_of_student() -> None:
    scores = np.array([[[0.2, 0.9, 0.4, 0.7, 0.1]]])
    found = estimate_mean_score(scores, None)
    expected = scipy.stats.t.interval(0.95, 4, scores.mean(), scipy.stats.sem(scores.ravel()))
    assert found.interval_95 == pytest.approx((max(0.0, expected[0]), min(1.0, expected[1])), abs=1e-12)


def test_degrees_of_freedom_of_scenes_and_trainings_are_combined() -> None:
    scores = 0.5 + np.array([-0.05, 0.05])[:, None, None] + np.linspace(-0.1, 0.1, 5)
    variances, freedoms = np.array([0.00125, 0.0025]), np.array([4.0, 1.0])
    freedom = variances.sum() ** 2 / (variances**2 / freedoms).sum()
    half = scipy.stats.t.ppf(0.975, freedom) * np.sqrt(variances.sum())
    assert estimate_mean_score(scores, None).interval_95 == pytest.approx((0.5 - half, 0.5 + half))


@pytest.mark.parametrize(
    ("flags", "rate", "count"),
    # Partners who make up for each other vary less than one partner, but their interval is as wide.
    [([[1, 1, 0, 1, 0, 1, 1, 1]], 0.75, 7), ([[1, 1, 1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 0, 1]], 0.5625, 8)],
)
def test_rates_have_wilson_intervals_with_the_quantile_of_student(
    flags: list[list[int]], rate: float, count: int
) -> None:
    weight = scipy.stats.t.ppf(0.975, 7) ** 2 / count
    center, half = rate + weight / 2.0, np.sqrt(weight * rate * (1.0 - rate) + weight**2 / 4.0)
    wanted = (center - half) / (1.0 + weight), (center + half) / (1.0 + weight)
    found = estimate_partner_rate(np.mean, np.array([flags], dtype=float), None)
    assert found.interval_95 == pytest.approx(wanted, abs=1e-12)


def test_differences_of_rates_are_at_least_minus_one() -> None:
    first, second = np.array([[[0.0, 0.0, 1.0]]]), np.array([[[1.0, 1.0, 0.0]]])
    assert estimate_mean_score(first, None, second).interval_95 == pytest.approx((-1.0, 1.0))
