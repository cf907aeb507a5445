"""Tests of the measurement of a giver's headroom."""

import itertools

import numpy as np
import pytest

from experiments.measure_headroom import compute_best_of


@pytest.mark.parametrize("k", [1, 2, 5])
def test_best_of_k_is_the_mean_over_all_choices_of_the_draws(k: int) -> None:
    successes = np.random.default_rng(0).random((4, 5)) < np.array([[0.0], [0.3], [0.6], [1.0]])
    choices = [successes[:, list(chosen)].any(axis=1) for chosen in itertools.combinations(range(5), k)]
    np.testing.assert_allclose(compute_best_of(successes, k), np.mean(choices, axis=0), atol=1e-12)
