from pathlib import Path

import pytest

from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.report_page import replay_links, report_page
from handover_marl.cli import main
from tests.benchmarking.test_comparison import folder
from tests.benchmarking.test_report import SETTINGS, episode, report
from tests.pages.outside import dangling, outside, references


def test_outcomes_with_intervals_and_the_way_to_every_replay() -> None:
    made = report_page(report(1, 1, 2, 2 | 4, 8), {214: "episodes/214.html", 219: "episodes/219.html"})
    assert outside(made) == dangling(made) == []
    # Two of five; both kinds of an episode that failed twice over lead to it.
    for word in ("11.8 to 76.9", "5 of 144 scenes (partial)", "2 of 5 episodes have one"):
        assert word in made
    links = references(made)
    assert {"#success", "#contact", "#drop", "#timeout"} <= set(links)
    assert links.count("episodes/214.html") == 1
    assert links.count("episodes/219.html") == 2
    assert "--replays failed" not in made


def test_settings_and_published_rows_are_told() -> None:
    made = report_page(report(1, 2))
    for word in (
        "mine",
        "replay",
        "exact",
        "0.1.0",
        "DexYCB, 1 object a scene",
        "published: Yang et al.",
        "--replays failed",
    ):
        assert word in made


def test_names_are_escaped() -> None:
    made = report_page(report(1, 2, receiver="<img src=https://example.org>", sight="a & b"))
    assert outside(made) == []
    assert "&lt;img src=https://example.org&gt;" in made


def test_thirty_six_scenes_make_a_small_page() -> None:
    episodes = tuple(episode(index, 1 + index % 2) for index in range(36))
    made = report_page(
        Report(SETTINGS, episodes, 36), {204 + 5 * index: f"episodes/{index}.html" for index in range(36)}
    )
    assert len(made.encode()) < 60_000


def test_links_lead_from_the_page_to_the_replays(tmp_path: Path) -> None:
    results = folder(tmp_path / "run", "mine", {0: 1, 1: 2})
    (results / "episodes").mkdir()
    for name in ("009.html", "001.html", "notes.html"):
        (results / "episodes" / name).write_text("")
    assert replay_links(results, results) == {1: "episodes/001.html", 9: "episodes/009.html"}
    assert replay_links(results, tmp_path) == {1: "run/episodes/001.html", 9: "run/episodes/009.html"}


def test_the_command_line_makes_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = (folder(tmp_path / name, name, {0: 1, 1: status}) for name, status in (("one", 1), ("other", 4)))
    (other / "episodes").mkdir()
    (other / "episodes" / "001.html").write_text("")
    assert main(["evaluate", str(other), "--out", str(tmp_path / "report.html")]) == 0
    assert "| other " in capsys.readouterr().out
    assert "other/episodes/001.html" in references((tmp_path / "report.html").read_text())
    assert main(["compare", str(one), str(other), "--out", str(tmp_path / "new" / "both.html")]) == 0
    both = (tmp_path / "new" / "both.html").read_text()
    assert outside(both) == []
    assert "../other/episodes/001.html" in references(both)
    assert "+50.00 (" in both
    assert main(["compare", str(one), str(one), "--out", str(tmp_path / "same.html")]) == 0
    assert "Every scene ended alike" in (tmp_path / "same.html").read_text()
    assert main(["compare", str(one), str(other), "--out", str(tmp_path / "both.pdf")]) == 2
    assert ".html" in capsys.readouterr().err
