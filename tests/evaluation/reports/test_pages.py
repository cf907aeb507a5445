from pathlib import Path

from handover_marl.cli import main
from handover_marl.evaluation.reports.report import find_replay_links, render_report_page
from tests.evaluation.reports.test_report import report
from tests.evaluation.test_comparison import folder
from tests.visualization.outside import dangling, outside, references


def test_outcomes_with_intervals_and_replay_links() -> None:
    made = render_report_page(report(1, 1, 2, 2 | 4, 8), {214: "episodes/214.html", 219: "episodes/219.html"})
    assert outside(made) == dangling(made) == []
    # Two of five episodes succeed; an episode with contact and drop is linked from both outcomes.
    for word in ("11.8 to 76.9", "5 of 144 scenes (partial)", "2 of 5 episodes have a replay"):
        assert word in made
    links = references(made)
    assert {"#success", "#contact", "#drop", "#timeout"} <= set(links)
    assert links.count("episodes/214.html") == 1
    assert links.count("episodes/219.html") == 2
    assert "--replays failed" not in made


def test_settings_are_shown_and_names_escaped() -> None:
    settings = {"receiver": "<img src=https://example.org>", "obs_mode": "pointcloud", "camera": "a & b"}
    made = render_report_page(report(1, 2, **settings))
    assert outside(made) == []
    words = ("&lt;img src=https://example.org&gt;", "0.1.0", "DexYCB, 1 object a scene", "published: Yang et al.")
    for word in (*words, "--replays failed"):
        assert word in made


def test_replay_links_are_relative_to_the_page(tmp_path: Path) -> None:
    results = folder(tmp_path / "run", "mine", {0: 1, 1: 2})
    (results / "episodes").mkdir()
    for name in ("214.html", "001.html", "notes.html"):
        (results / "episodes" / name).write_text("")
    assert find_replay_links(results, results) == {1: "episodes/001.html", 214: "episodes/214.html"}
    assert main(["evaluate", str(results), "--out", str(tmp_path / "report.html")]) == 0
    assert "run/episodes/214.html" in references((tmp_path / "report.html").read_text())
    assert main(["evaluate", str(results), "--out", str(tmp_path / "report.pdf")]) == 2
