"""experiments/make_results.py stores outcomes, computes the pages from them, and refuses partial evaluations."""

import itertools
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import handover_marl
from experiments import make_results
from handover_marl.datasets.splits import list_split_scenes
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.metadata import ResultMetadata
from handover_marl.evaluation.results import EpisodeResult, ResultFolder, encode_result
from tests.docs.test_results import check_outcome_row, list_outcome_rows
from tests.evaluation.quick import write_results


def make_folder(path: Path, receiver: str, outcomes: Iterator[int], wait: str = "3") -> Path:
    """Write a result folder of the whole s0 test split with some outcomes."""
    settings = ResultMetadata("s0", "test", receiver, "replay", "exact", "dexycb", "9.9.9", "abc.1", wait_s=wait)
    folder, scenes = ResultFolder(path, settings), list_split_scenes("s0", "test", lambda scene: "")
    for index, (scene, status) in enumerate(zip(scenes, outcomes, strict=False)):
        steps = 5000 + 7 * index
        result = EpisodeResult(
            index, EpisodeStatus(status), steps, 0.0, scene, None, n_objects=1, models="stand-in hand", machine="m"
        )
        folder.write(result, encode_result(result, np.zeros((1, 9), np.float32), np.array([0.05 + 0.01 * index])))
    return path


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a copy of the templates and of stored outcomes, which the script uses in this test."""
    folder = tmp_path / "docs" / "results"
    shutil.copytree(make_results.DATA, folder / "data")
    real = make_results.FOLDER
    for constant in ("FOLDER", "DATA", "EPISODES", "TEST_USE"):
        monkeypatch.setattr(make_results, constant, folder / getattr(make_results, constant).relative_to(real))
    return folder


@pytest.mark.slow
def test_stored_outcomes_are_printed(pages: Path, tmp_path: Path) -> None:
    """Rates, times and AS of two stored evaluations are those of their files, and so is their paired difference."""
    reactive, yang = itertools.cycle([1, 1, 1, 1, 1, 6, 8]), itertools.cycle([1, 1, 2, 4, 1])
    added = (
        make_folder(tmp_path / "a", "reactive", reactive, "0"),
        make_folder(tmp_path / "b", "yang2021", yang),
        make_folder(tmp_path / "c", "gaddpg@own weights a888ea47:wait=0.0", itertools.cycle([1, 4]), "0"),
    )
    before = {one.path for one in make_results.read_evaluations()}
    make_results.main(make_results.Args(added, "a test", pages))
    assert {one.path for one in make_results.read_evaluations()} == before, "each one took a place"
    rows = [(row, path) for row, path in list_outcome_rows(pages) if "9.9.9" in row["version"]]
    assert len(rows) == 3
    for row, path in rows:
        check_outcome_row(row, path)
    tables = (pages / "tables.md").read_text()
    for name in ("reactive", "yang2021", "gaddpg"):
        assert f"Input of `{name}`: {make_results.INPUTS[name][0]}." in tables
    text = (pages / "reactive.md").read_text()
    start = r"\| `reactive` \(0 s, version 9\.9\.9\) \| `yang2021`"
    (difference,) = [line for line in text.splitlines() if re.match(start, line)]
    pairs = list(zip([1, 1, 1, 1, 1, 6, 8] * 30, [1, 1, 2, 4, 1] * 30, strict=False))[:144]
    for column, flag in enumerate((1, 2, 4, 8), start=4):
        gained = sum(bool(one & flag) and not other & flag for one, other in pairs)
        lost = sum(bool(other & flag) and not one & flag for one, other in pairs)
        middle, n = (gained - lost) / 146, 146
        half = 1.959963984540054 * np.sqrt(((gained + lost + 1) / n - middle**2) / n)
        expected = [100 * (gained - lost) / 144, 100 * (middle - half), 100 * (middle + half)]
        found = [float(number) for number in re.findall(r"[+-][\d.]+", difference.split("|")[column + 1])]
        assert found == pytest.approx(expected, abs=0.051)
    (command,) = re.findall(r"handover-marl compare .*reactive-dexycb-s0-0\.0\.json .*yang2021.*", text)
    files = [tmp_path / path for path in command.split()[2:]]
    assert handover_marl.compare(*files).build_tables()[0].rows[0][3] in difference
    assert "- s0, wait 0 s, version 9.9.9: " in text
    log = (pages / "data" / "test_use.csv").read_text()
    assert 'dexycb s0,9.9.9,yang2021,"replay, exact",144,a test\n' in log
    assert log.count(",a test\n") == 3


@pytest.mark.slow
def test_adding_twice_changes_nothing(pages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make_results, "draw_figure", lambda evaluations, path: None)
    before = len(make_results.read_evaluations())
    folder = make_folder(tmp_path / "a", "omg:wait=1.5", itertools.cycle([1, 2]), "1.5")
    make_results.main(make_results.Args((folder,), "a test", pages))
    stored = {path: path.read_bytes() for path in (pages / "data").rglob("*.*") if path.is_file()}
    make_results.add_evaluation(folder, "a test")
    assert {path: path.read_bytes() for path in (pages / "data").rglob("*.*") if path.is_file()} == stored
    assert len(make_results.read_evaluations()) == before + 1


def test_a_partial_folder_is_refused(pages: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="whole test split"):
        make_results.add_evaluation(write_results(tmp_path / "partial"), "a test")
    assert make_results.TEST_USE.read_text().count("a test") == 0
