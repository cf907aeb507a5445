"""experiments/measure_results.py simulates a scene of several setups once."""

from pathlib import Path

import pytest

from experiments import measure_results
from handover_marl.datasets.dataset import Dataset
from handover_marl.evaluation.reports.report_files import evaluate
from tests.short_episodes import shorten_episodes

SCENES = {"s0": (9, 14), "s2": (3, 9)}


def test_a_shared_scene_is_simulated_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_episodes(monkeypatch, 1500)
    monkeypatch.setattr(Dataset, "list_scenes", lambda dataset, setup, split: SCENES[setup])
    args = measure_results.Args(("hold",), ("s0", "s2"), dataset="synthetic", physics="fast", workers=1, out=tmp_path)
    first, second = measure_results.measure_receiver("hold", args)
    assert [report.n_resumed for report in (first, second)] == [0, 1]
    assert [result.scene_id for result in second.episodes] == [3, 9]
    shared = [next(result for result in report.episodes if result.scene_id == 9) for report in (first, second)]
    assert [result.index for result in shared] == [0, 1]
    assert shared[0].steps == shared[1].steps
    assert shared[0].fluency == shared[1].fluency
    stored = evaluate(tmp_path / "hold-synthetic-s2")
    assert not isinstance(stored, tuple)
    assert stored.episodes == second.episodes
