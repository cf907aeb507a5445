"""Tests of comparisons of result folders, of two physics engines, and of cross-play."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

import handover_marl
from handover_marl.cli import main
from handover_marl.datasets.splits import list_split_scenes
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.comparison import Comparison
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.results import EpisodeResult
from tests.evaluation.quick import write_results
from tests.evaluation.reports.test_report import SETTINGS, episode
from tests.helpers.short_episodes import shorten_episodes


def folder(path: Path, receiver: str, outcomes: dict[int, int], fingerprint: str = "data", **settings: str) -> Path:
    metadata = replace(SETTINGS, receiver=receiver, **settings)
    scenes = list_split_scenes("s0", metadata.split, lambda scene: "")
    episodes = (
        EpisodeResult(index, EpisodeStatus(status), 100 + index, 0.0, scenes[index], fingerprint=fingerprint)
        for index, status in outcomes.items()
    )
    return write_results(path, Report(metadata, tuple(episodes)))


def test_common_scenes_are_paired(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = folder(tmp_path / "one", "mine", {0: 1, 1: 1, 2: 2, 5: 1})
    other = folder(tmp_path / "other", "theirs", {0: 1, 1: 4, 2: 2, 7: 1})
    found = handover_marl.compare(one, other)
    assert [(a.index, b.index) for a, b in found.pairs] == [(0, 0), (1, 1), (2, 2)]
    rates, changes, _ = found.build_tables()
    assert [str(cell).split()[0] for cell in rates.rows[0]] == ["success", "66.67", "33.33", "+33.33"]
    # A succeeds after 100 and 101 of 13,000 steps, B once after 100.
    assert [str(cell).split()[0] for cell in rates.rows[-1]] == ["AS", "66.15", "33.08", "+33.07"]
    titles = ("outcome", "steps")
    assert [*changes.header[2:]] == [f"{name} {title}" for title in titles for name in ("mine", "theirs")]
    assert [*map(list, changes.rows)] == [["214", "-", "success", "drop", "101", "101"]]
    assert main(["compare", str(one), str(other)]) == 0
    text = capsys.readouterr().out
    assert "Receiver mine" in text
    assert "3 scenes that both folders have" in text
    assert rates.header[1:4] == ["mine %", "theirs %", "mine minus theirs, points"]
    assert handover_marl.compare(one, one).build_tables()[0].header[1:3] == ["A %", "B %"]
    command = ["compare", str(one), str(other), "--format", "csv", "--columns"]
    assert main([*command, "metric", "theirs %"]) == 0
    assert capsys.readouterr().out.splitlines()[:2] == ["metric,theirs %", "success,33.33 (6.1 to 79.2)"]
    for columns, message in ((["rate"], "unknown column 'rate'"), (["theirs %", "scene id"], "must be of one table")):
        assert main([*command, *columns]) == 2
        assert message in capsys.readouterr().err


def test_scenes_in_which_an_early_grab_is_unknown_are_left_out() -> None:
    episodes = [episode(0, EpisodeStatus.SUCCESS, late_s=0.0, early_grab=grab) for grab in (True, None)]
    rows = Comparison(*(Report(SETTINGS, (one,)) for one in episodes)).build_tables()[-1].rows
    assert [str(row[0]) for row in rows] == ["late s"]


def test_incomparable_folders_are_refused(tmp_path: Path) -> None:
    one = folder(tmp_path / "one", "mine", {0: 1})
    three = folder(tmp_path / "three", "mine", {0: 1}, split="val")
    for first, second, message in (
        (one, folder(tmp_path / "two", "mine", {0: 1}, fingerprint="other"), "different data"),
        (one, three, "must have the same split, got test and val$"),
        (three, one, "must have the same split, got val and test$"),
        (one, folder(tmp_path / "four", "mine", {3: 1}), "at least one scene in common"),
        (one, tmp_path / "five", "does not exist"),
    ):
        with pytest.raises(ResultsError, match=message):
            handover_marl.compare(first, second)
    # Fingerprints of different versions are not compared: the same data may have another fingerprint.
    newer = folder(tmp_path / "newer", "mine", {0: 1}, fingerprint="other", version="2")
    assert len(handover_marl.compare(one, newer).pairs) == len(handover_marl.compare(newer, one).pairs) == 1


def test_average_success_without_a_success_has_an_interval(tmp_path: Path) -> None:
    """Wilson's interval of 0 of 5 ends at 43.4 %; Agresti and Min's of equal failures at 28.0 points."""
    failures = folder(tmp_path / "failures", "mine", dict.fromkeys(range(5), 8))
    rates = handover_marl.compare(failures, failures).build_tables()[0]
    interval = "0.00 (0.0 to 43.4)"
    assert [*rates.rows[-1]] == ["AS", interval, interval, "+0.00 (-28.0 to +28.0)"]
    assert handover_marl.load_report(failures).official_means["AS"].format(".2f", ".1f") == interval


def report(physics: str, ends: list[tuple[int, int]]) -> Report:
    episodes = (episode(index, *end, scene_id=100 + index) for index, end in enumerate(ends))
    return Report(replace(SETTINGS, split="val", physics=physics), tuple(episodes))


def test_text_of_a_comparison_of_physics() -> None:
    exact = report("exact", [(1, 4000), (2, 3500), (4, 4100), (1, 4200)])
    fast = report("fast", [(1, 4003), (2, 3500), (1, 4900), (1, 4199)])
    text = str(Comparison(fast, exact))
    assert "3 of 4 scenes have the same outcome: 75.00 (30.1 to 95.4) %" in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "|" in line]
    assert ["metric", "fast %", "exact %", "fast minus exact, points"] in rows
    (rates,) = [row for row in rows if row[0] == "success"]
    assert [cell.split()[0] for cell in rates] == ["success", "75.00", "50.00", "+25.00"]
    assert ["102", "003_cracker_box", "success", "drop", "4900", "4100"] in rows
    assert not any(row[0] in ("100", "101", "103") for row in rows), "agreeing scenes are not listed"


@pytest.mark.slow
def test_commands(
    fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 100)
    options = ["--scenes", "9", "--workers", "1", "--data-dir", str(fake_data), "--out"]
    out = tmp_path / "cross"
    command = ["crossplay", "--givers", "replay", "hesitant", "--receivers", "hold", "--physics", "fast", *options]
    assert main([*command, str(out)]) == 0
    assert "Cross-play on s0 val, 1 of 36 scenes" in capsys.readouterr().out
    assert (out / "crossplay.md").read_text().startswith("# Cross-play")
    rows = list(csv.DictReader((out / "crossplay.csv").open()))
    expected = [("replay", "hold", "1"), ("hesitant", "hold", "1")]
    assert [(row["giver"], row["receiver"], row["n_episodes"]) for row in rows] == expected
    assert rows[0]["timeout"] == "1.000000"
    with Image.open(out / "crossplay.png") as picture:
        assert picture.width > 300
    assert (out / "hesitant-hold" / "000.npz").is_file()
