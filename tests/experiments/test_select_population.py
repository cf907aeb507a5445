"""Tests of the selection of diverse feature rows by a determinant."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.strangers.select_population import (
    EVENTS,
    compute_diversity,
    count_events,
    normalize_features,
    select_diverse,
)
from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.results.episode_result import EpisodeResult


@st.composite
def feature_rows(draw: st.DrawFn) -> np.ndarray:
    n, e = draw(st.integers(3, 7)), draw(st.integers(3, 6))
    return np.random.default_rng(draw(st.integers(0, 1000))).random((n, e))


@given(feature_rows())
def test_no_subset_is_more_diverse(features: np.ndarray) -> None:
    chosen = select_diverse(features, 3)
    assert list(chosen) == sorted(set(chosen))
    largest = max(compute_diversity(features, each) for each in itertools.combinations(range(len(features)), 3))
    assert compute_diversity(features, chosen) == pytest.approx(largest)


@given(feature_rows())
def test_equal_rows_are_not_chosen_twice(features: np.ndarray) -> None:
    doubled = np.vstack([features, features])
    chosen = select_diverse(doubled, 3)
    assert len({number % len(features) for number in chosen}) == 3


def test_more_rows_than_events_are_refused() -> None:
    assert compute_diversity(np.random.default_rng(0).random((5, 2)), [0, 1, 2]) == pytest.approx(0.0)
    for k in (0, 3):
        with pytest.raises(ValueError, match="k must be from 1 to 2"):
            select_diverse(np.ones((5, 2)), k)
    with pytest.raises(ValueError, match="subsets must be at most"):
        select_diverse(np.ones((50, 20)), 10)


def test_features_are_relative_to_the_maximum() -> None:
    found = normalize_features([[1.0, 0.0], [2.0, 0.0]])
    np.testing.assert_allclose(found, [[1.0 / 2.001, 0.0], [2.0 / 2.001, 0.0]])


def make_episode(status: EpisodeStatus, fluency: FluencyMetrics | None, release: int | None = None) -> EpisodeResult:
    return EpisodeResult(0, status, 5000, 0.1, release_step=release, fluency=fluency)


def test_events_are_means_over_episodes() -> None:
    fluency = FluencyMetrics(4.0, 0.5, 0.25, 0.1, None, 3.0, 0.1, 0.8, -2.0, 0.6, gripper_path=1.5)
    unreleased = FluencyMetrics(None, 0.5, 0.25, 0.1, None, 3.0, 0.1, 0.4, -2.0, 0.6)
    events = count_events(
        [make_episode(EpisodeStatus.SUCCESS, fluency, 4000), make_episode(EpisodeStatus.TIMEOUT, unreleased)]
    )
    found = dict(zip(EVENTS, events, strict=True))
    assert found["success"] == found["timeout"] == found["release"] == 0.5
    assert found["handover time s"] == 2.0
    assert found["gripper path m"] == 0.75
    assert found["giver path m"] == pytest.approx(0.6)
    with pytest.raises(ValueError, match="must have fluency metrics"):
        count_events([make_episode(EpisodeStatus.SUCCESS, None)])
