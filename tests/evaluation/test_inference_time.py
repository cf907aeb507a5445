"""Tests of evaluations in which the person does not wait for the receiver's inference."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import EvaluationConfig
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.reports.report import Report
from tests.docs.pages import REPOSITORY, checked_table
from tests.evaluation.quick import SHORT

pytestmark = pytest.mark.slow

SCENE = 19
LATE = 0.05  # s
OPTIONS: dict[str, Any] = {
    **{"giver": "replay", "receiver": "yang2021", "setup": "s0", "split": "val", "scenes": [SCENE]},
    **{"dataset": "synthetic", "physics": "fast", "workers": 1, "progress": False},
}


def run(out: Path, **options: Any) -> Report:
    return handover_marl.evaluate_pair(out=out, **{**OPTIONS, **options})


def read_actions(folder: Path) -> np.ndarray:
    with np.load(folder / "002.npz") as file:
        return file["action"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[float | None, Path]:
    """Return the result folders of evaluations without inference time, with none that takes time, and with some."""
    found: dict[float | None, Path] = {time: tmp_path_factory.mktemp("results") for time in (None, 0.0, LATE)}
    for time, folder in found.items():
        run(folder, inference_time=time)
    return found


def test_without_inference_time_nothing_changes(folders: dict[float | None, Path]) -> None:
    """Reports without inference time do not mention it; with a time of 0 s the motion is equal to the bit."""
    (off,), (zero,) = (handover_marl.load_report(folders[time]).episodes for time in (None, 0.0))
    np.testing.assert_array_equal(read_actions(folders[None]), read_actions(folders[0.0]))
    for name in ("status", "steps", "release_step", "fluency"):
        assert getattr(off, name) == getattr(zero, name), name
    assert (off.late_s, off.early_grab) == (None, None)
    assert (zero.late_s, zero.early_grab) == (0.0, False)
    written = b"".join(path.read_bytes() for path in sorted(folders[None].iterdir()))
    for word in (b"inference", b"late_s", b"early", b"late s"):
        assert word not in written


def test_a_slow_receiver_acts_late_and_repeatably(folders: dict[float | None, Path], tmp_path: Path) -> None:
    (off,), (late,) = (handover_marl.load_report(folders[time]).episodes for time in (None, LATE))
    assert late.steps > off.steps
    with np.load(folders[LATE] / "002.npz") as file:
        assert late.late_s == pytest.approx(LATE * np.count_nonzero(file["elapsed_time"]), abs=LATE)
    run(tmp_path, inference_time=LATE)
    np.testing.assert_array_equal(read_actions(tmp_path), read_actions(folders[LATE]))
    assert handover_marl.verify(tmp_path, progress=False).is_verified


def test_reports_state_the_inference_time(folders: dict[float | None, Path], tmp_path: Path) -> None:
    folder, label = folders[LATE], f"inference time {LATE} s a decision"
    report = handover_marl.load_report(folder)
    assert label in report.heading
    for name in ("report.md", "report.html"):
        text = (folder / name).read_text()
        assert f"Not comparable with official results: the person does not wait for the policy ({label})." in text
        assert "early grab" in text
    stored = json.loads((folder / "report.json").read_text())
    (row,) = csv.DictReader((folder / "episodes.csv").read_text().splitlines())
    assert row["inference_time"] == stored["inference_time"] == str(LATE)
    assert float(row["late_s"]) == stored["fluency"]["late_s"]["mean"] == stored["episodes"][0]["late_s"] > 0.0
    assert stored["fluency"]["early_grab"]["n"] == 1
    assert "late s" in str(handover_marl.compare(folder, folder))
    compared = str(handover_marl.compare(folder, folders[None]))
    assert f"Inference time differs: {LATE} and 0 (the person waits)." in compared
    same = {key: value for key, value in OPTIONS.items() if key not in ("giver", "receiver")}
    crossed = handover_marl.crossplay(("replay", {}), "hold", inference_time=LATE, world_config=SHORT, **same)
    assert label in str(crossed)
    assert next(csv.DictReader(crossed.to_csv().splitlines()))["inference_time"] == str(LATE)


def test_official_evaluations_have_no_inference_time(folders: dict[float | None, Path]) -> None:
    with pytest.raises(ResultsError, match=r"another evaluation .*inference time"):
        run(folders[LATE])
    official: Any = handover_marl.benchmark
    for call, message in (
        (
            lambda: official(inference_time=0.0),
            r"inference_time must be left out of benchmark\(\), got 0.0; use evaluate_",
        ),
        (
            lambda: handover_marl.strangers("hold", inference_time=0.0),
            r"left out of strangers\(\), got 0.0; use crossplay",
        ),
        (lambda: EvaluationConfig(inference_time=-0.1), "inference_time must be a time from 0 to 10 s"),
        (lambda: EvaluationConfig(inference_time="fast"), "'measured' or None, got fast"),  # type: ignore[arg-type]
    ):
        with pytest.raises(OptionError, match=message):
            call()


def test_the_page_lists_both_metrics() -> None:
    rows = checked_table(REPOSITORY / "docs" / "reference" / "metrics.md", "inference time")
    assert [row[:2] for row in rows] == [["`late s`", "`late_s`"], ["`early grab %`", "`early_grab`"]]
