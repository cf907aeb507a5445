"""Episode files hold the outcomes of a result folder, and reports and comparisons read them like the folder."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.errors import ResultsError
from handover_marl.evaluation.results import format_episode_file, read_episode_file
from tests.evaluation.quick import write_results


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_results(tmp_path_factory.mktemp("results"))


def write_file(folder: Path, path: Path) -> Path:
    report = handover_marl.evaluate(folder)
    first, second = report.episodes
    assert first.fluency is not None
    moved = replace(first, fluency=replace(first.fluency, reach=first.fluency.reach + 0.25, min_distance=None))
    path.write_text(format_episode_file(report.metadata, (moved, second)))
    return path


def test_a_file_holds_what_the_folder_holds(folder: Path, tmp_path: Path) -> None:
    stored, report = read_episode_file(write_file(folder, tmp_path / "a.json")), handover_marl.evaluate(folder)
    assert stored[0] == report.metadata
    for found, true in zip(stored[1], report.episodes, strict=True):
        assert replace(found, plan_s=0.0, fluency=None) == replace(true, plan_s=0.0, fluency=None)
        assert found.plan_s == pytest.approx(true.plan_s, abs=6e-5)
    assert stored[1][0].fluency is not None
    assert stored[1][0].fluency.min_distance is None
    metrics, true_metrics = (list(vars(episodes[1].fluency).values()) for episodes in (stored[1], report.episodes))
    assert [value is None for value in metrics] == [value is None for value in true_metrics]
    known = [value for value in true_metrics if value is not None]
    assert [value for value in metrics if value is not None] == pytest.approx(known, rel=6e-4)


def test_a_file_is_compared_with_a_folder(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_file(folder, tmp_path / "a.json")
    found = handover_marl.compare(path, folder)
    assert [(one.scene_id, other.scene_id) for one, other in found.pairs] == [(209, 209), (214, 214)]
    rows = {row[0]: row[1:] for row in found.build_tables()[-1].rows}
    assert float(rows["reach m"][0]) == 0.125, "the mean of 0.25 m and 0"
    assert rows["min distance cm"][2] == 1, "only one scene has a value in both"
    assert main(["compare", str(path), str(folder)]) == main(["evaluate", str(path)]) == 0
    text = capsys.readouterr().out
    assert "| reach m " in text
    assert re.search(r"\de-\d", text) is None, "numbers have no exponents"


def change(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update({key: value})


def change_row(column: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["episodes"][0].__setitem__(content["columns"].index(column), value)


@pytest.mark.parametrize(
    "spoil",
    [
        change("episodes", []),
        change("metadata", {}),
        change("columns", None),
        change("common", {"outcome": "triumph"}),
        change("common", {"index": 0, "outcome": "success"}),
        change_row("index", 1),
        change_row("scene_id", 214),
        change_row("scene_id", 3),
        change_row("steps", -1),
        change_row("plan_s", float("nan")),
        change_row("reach", "far"),
        lambda content: content["metadata"].update(split="all"),
        lambda content: content["metadata"].update(receiver="\x1b[31mred"),
        lambda content: content["common"].update(machine="\x1b[31mred"),
    ],
)
def test_impossible_files_are_refused(spoil: Callable[[dict[str, Any]], None], folder: Path, tmp_path: Path) -> None:
    path = write_file(folder, tmp_path / "a.json")
    content = json.loads(path.read_text())
    spoil(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ResultsError, match=r"a\.json"):
        handover_marl.evaluate(path)
