"""Tests of scripts that measure, and of examples for copying at a small size."""

import itertools

import numpy as np
import pytest

from experiments.measure_headroom import compute_best_of
from handover_marl.datasets.synthetic import SyntheticDataset
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import script


@pytest.mark.parametrize("k", [1, 2, 5])
def test_best_of_k_is_the_mean_over_all_choices_of_the_draws(k: int) -> None:
    successes = np.random.default_rng(0).random((4, 5)) < np.array([[0.0], [0.3], [0.6], [1.0]])
    choices = [successes[:, list(chosen)].any(axis=1) for chosen in itertools.combinations(range(5), k)]
    np.testing.assert_allclose(compute_best_of(successes, k), np.mean(choices, axis=0), atol=1e-12)


@pytest.mark.slow
def test_own_receiver(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shorten_episodes(monkeypatch, 1000)
    example, scenes = script("own_receiver", monkeypatch), SyntheticDataset().list_scenes("s0", "val")[:1]
    found = example.main(example.Args(dataset="synthetic", scenes=scenes, workers=1))
    assert [episode.scene_id for episode in found.episodes] == list(scenes)
    assert "success" in capsys.readouterr().out
