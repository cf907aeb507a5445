"""experiments/make_results.py stores result folders and refuses those that are not official."""

from dataclasses import replace
from pathlib import Path

import pytest

import handover_marl
from experiments import make_results

FOLDER = Path(__file__).parents[1] / "data" / "v0_7_0" / "benchmark"


def test_a_partial_folder_is_refused() -> None:
    with pytest.raises(SystemExit, match="whole test split"):
        make_results.read_evaluation(FOLDER)


def test_a_whole_folder_becomes_an_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    report = handover_marl.evaluate(FOLDER)
    assert not isinstance(report, tuple)
    official = replace(report.metadata, physics="exact", split="test")
    whole = replace(report, metadata=official, n_split_scenes=len(report.episodes))
    monkeypatch.setattr(handover_marl, "evaluate", lambda folder: whole)
    entry = make_results.read_evaluation(FOLDER)
    assert entry.episodes == len(report.episodes) == entry.success + entry.contact + entry.drop + entry.timeout
    assert (entry.receiver, entry.version, entry.wait_s) == (report.metadata.receiver, "0.7.0", 3.0)
    assert entry.as_percent == pytest.approx(100 * report.average_success, abs=0.05)
    assert make_results.format_row(entry)[0] == f"`{report.metadata.receiver}`"
