import json
from pathlib import Path

import pytest

from handover_marl.cli import main
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.metadata import ResultMetadata
from handover_marl.evaluation.reports.report import Report, find_replay_links, render_report_page
from handover_marl.evaluation.results import EpisodeResult
from tests.evaluation.quick import write_results
from tests.visualization.outside import dangling, outside, references

SETTINGS = ResultMetadata("s0", "test", "mine", "replay", "exact", "dexycb", "0.1.0")


def episode(index: int, status: int, steps: int = 5000, plan: float = 0.1, **extras: object) -> EpisodeResult:
    named = {"scene_id": 204 + 5 * index, "object_name": "003_cracker_box", "n_objects": 1, "machine": "a machine"}
    return EpisodeResult(index, EpisodeStatus(status), steps, plan, **{**named, **extras})


def report(*statuses: int, **settings: str) -> Report:
    episodes = tuple(episode(index, status) for index, status in enumerate(statuses))
    return Report(ResultMetadata(**{**SETTINGS.__dict__, **settings}), episodes)


def cells(text: str, start: str, *titles: str) -> list[str]:
    """Return cells of a row of the official table, which is printed in two parts."""
    found: dict[str, str] = {}
    header: list[str] = []
    for line in text.splitlines():
        row = [cell.strip() for cell in line.split("|")]
        if "success %" in row or "exec s" in row:
            header = row
        elif line.startswith(f"| {start}") and len(row) == len(header):
            found |= dict(zip(header, row, strict=True))
    return [found[title] for title in titles]


def test_official_metrics() -> None:
    """Intervals of two times are their range in seconds; the table has no interval of the total time."""
    episodes = (
        episode(0, 1, 4000, 0.25),
        episode(1, 1, 6000, 0.5),
        episode(2, 2, 100, 9.0),
        episode(3, 2 | 4, 200, 9.0),
        episode(4, 8, 13000, 9.0),
    )
    found = Report(SETTINGS, episodes)
    assert [found.compute_rate(EpisodeStatus(bit)) for bit in (1, 2, 4, 8)] == [0.4, 0.4, 0.2, 0.2]
    assert found.average_success == pytest.approx((9 + 7) / 13 / 5)
    assert found.to_json()["AS"]["mean"] == found.average_success
    titles = ("success %", "AS %", "exec s", "plan s", "total s")
    assert cells(str(found), "mine", *titles) == ["40.00 (2/5)", "24.62", "5.000", "0.375", "5.375"]
    intervals = ["11.8 to 76.9", "0.0 to 49.3", "4.000 to 6.000", "0.250 to 0.500", "-"]
    assert cells(str(found), "95 % interval", *titles) == intervals
    assert cells(str(found), "n", *titles) == ["5", "5", "2", "2", "2"]


def test_no_success_prints_dashes_and_json_has_null() -> None:
    found = report(2, 4, 8)
    titles = ("success %", "exec s", "plan s", "total s")
    assert cells(str(found), "mine", *titles) == ["0.00 (0/3)", "-", "-", "-"]
    assert "nan" not in str(found).lower()
    content = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert (content["times"]["exec_s"]["mean"], content["fluency"]) == (None, {})


def test_the_text_states_what_was_evaluated() -> None:
    text = str(report(1, 2, robot="panda_camera", wait_s="1.5", physics="fast", world="another"))
    assert "2 of 144 scenes (partial)" in text
    assert "Receiver mine (wait 1.5 s, robot panda_camera), giver replay" in text
    assert "not the official ones (another)" in text
    assert "exact physics" in text
    plain = report(1, 2)
    assert "Receiver mine, giver replay" in plain.heading
    assert "not the official ones" not in plain.format_notes()
    assert cells(str(plain), "mine", "wait s") == ["-"]
    assert cells(str(plain), "published: GA-DDPG w/o hold", "AS %", "wait s") == ["23.60*", "0"]


@pytest.mark.parametrize(
    "settings",
    [{"split": "val"}, {"dataset": "synthetic"}, {"physics": "fast"}, {"world": "0123abcd"}, {"giver": "cooperative"}],
)
def test_published_rows_only_with_comparable_results(settings: dict[str, str]) -> None:
    assert "published:" not in str(report(1, 2, **settings))


def test_breakdown_by_object() -> None:
    # Ten episodes with the mug: one success, two contacts, three drops and four timeouts.
    statuses = (1, 2, 2, 4, 4, 4, 8, 8, 8, 8)
    mugs = tuple(episode(index, status, object_name="025_mug") for index, status in enumerate(statuses))
    table = Report(SETTINGS, (*mugs, episode(10, 1))).build_tables()[1]
    assert [*table.header] == ["object name", "n episodes", "success %", "n contact", "n drop", "n timeout"]
    assert [*table.rows[-1]] == ["025_mug", 10, "10.0 (1.8 to 40.4)", 2, 3, 4]


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
    results = write_results(tmp_path / "run")
    (results / "episodes").mkdir()
    for name in ("214.html", "001.html", "notes.html"):
        (results / "episodes" / name).write_text("")
    assert find_replay_links(results, results) == {1: "episodes/001.html", 214: "episodes/214.html"}
    assert main(["report", str(results), "--out", str(tmp_path / "report.html")]) == 0
    assert "run/episodes/214.html" in references((tmp_path / "report.html").read_text())
    assert main(["report", str(results), "--out", str(tmp_path / "report.pdf")]) == 2
