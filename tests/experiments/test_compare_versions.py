"""experiments/analysis/compare_versions.py finds changed actions and missing files."""

from pathlib import Path

import numpy as np
import pytest

from tests.learning.training.scripts import script


def write_results(folder: Path, action: float, machine: str = "a") -> Path:
    (folder / "fast-replay-hold").mkdir(parents=True)
    (folder / "fast-replay-hold" / "finished").touch()
    arrays = {"action": np.full((3, 9), action, np.float32), "result": np.int64(1), "machine": np.str_(machine)}
    np.savez(folder / "fast-replay-hold" / "000.npz", **arrays)
    return folder


def test_equal_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = script("compare_versions", monkeypatch)
    old, new = write_results(tmp_path / "old", 0.5), write_results(tmp_path / "new", 0.5, machine="b")
    assert module.compare(module.Compare(old, new)) == 0


def test_a_changed_action_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = script("compare_versions", monkeypatch)
    old = write_results(tmp_path / "old", 0.5)
    new = write_results(tmp_path / "new", float(np.nextafter(np.float32(0.5), np.float32(1))))
    assert module.compare(module.Compare(old, new)) == 1
    assert "000.npz: action" in capsys.readouterr().out
    (new / "fast-replay-hold" / "000.npz").unlink()
    assert module.compare(module.Compare(old, new)) == 1
