import json

import pytest

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.metadata import ResultMetadata
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.results import EpisodeResult

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
    episodes = (
        episode(0, 1, 4000, 0.2),
        episode(1, 1, 6000, 0.4),
        episode(2, 2, 100, 9.0),
        episode(3, 2 | 4, 200, 9.0),
        episode(4, 8, 13000, 9.0),
    )
    found = Report(SETTINGS, episodes)
    assert [found.compute_rate(EpisodeStatus(bit)) for bit in (1, 2, 4, 8)] == [0.4, 0.4, 0.2, 0.2]
    means = [found.official_means[key].mean for key in ("exec_s", "plan_s", "total_s")]
    assert means == pytest.approx([5.0, 0.3, 5.3])


def test_no_success_prints_dashes_and_json_has_null() -> None:
    found = report(2, 4, 8)
    titles = ("success %", "exec s", "plan s", "total s")
    assert cells(str(found), "mine", *titles) == ["0.00 (0/3)", "-", "-", "-"]
    assert "nan" not in str(found).lower()
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["times"]["exec_s"]["mean"] is None


def test_rates_have_two_decimals_and_counts() -> None:
    text = str(report(1, 1, 6, 8, 8, 8, 8))
    titles = ("success %", "contact %", "drop %", "timeout %")
    assert cells(text, "mine", *titles) == ["28.57 (2/7)", "14.29 (1/7)", "14.29 (1/7)", "57.14 (4/7)"]
    assert cells(text, "95 % interval", "success %") == ["8.2 to 64.1"]


def test_the_heading_names_the_shard_and_the_robot() -> None:
    text = report(1, 2, shard="3/16 of 9,14,19", robot="panda_camera").heading
    assert "2 of 144 scenes (partial, shard 3/16)" in text
    assert "mine (robot panda_camera), giver replay" in text
    assert "robot" not in report(1, 2, robot="".join(["pan", "da"])).heading
    assert "wait" not in report(1, 2).heading


@pytest.mark.parametrize(
    "settings", [{"split": "val"}, {"dataset": "synthetic"}, {"physics": "fast"}, {"world": "0123abcd"}]
)
def test_published_rows_only_with_comparable_results(settings: dict[str, str]) -> None:
    assert "published:" not in str(report(1, 2, **settings))


def test_breakdown_by_object() -> None:
    # Ten episodes with the mug: one success, two contacts, three drops and four timeouts.
    statuses = (1, 2, 2, 4, 4, 4, 8, 8, 8, 8)
    mugs = tuple(episode(index, status, object_name="025_mug") for index, status in enumerate(statuses))
    lines = str(Report(SETTINGS, (*mugs, episode(10, 1)))).splitlines()
    mug = next(number for number, line in enumerate(lines) if "025_mug" in line)
    header = next(line for line in reversed(lines[:mug]) if "object name" in line)
    cells = {title.strip(): cell.strip() for title, cell in zip(header.split("|"), lines[mug].split("|"), strict=True)}
    assert cells["success %"] == "10.0 (1.8 to 40.4)"
    assert [cells[title] for title in ("n episodes", "n contact", "n drop", "n timeout")] == ["10", "2", "3", "4"]


def test_average_success_rewards_speed() -> None:
    episodes = (episode(0, 1, 2600), episode(1, 1, 13000), episode(2, 2, 100), episode(3, 8, 13000))
    found = Report(SETTINGS, episodes)
    assert found.average_success == pytest.approx((0.8 + 0.0) / 4)
    assert found.to_json()["AS"]["mean"] == found.average_success  # type: ignore[index]


def test_tables_show_average_success_and_wait() -> None:
    text = str(report(1, 2, wait_s="1.5"))
    assert "Receiver mine (wait 1.5 s), giver replay" in text
    titles = ("AS %", "wait s")
    assert cells(text, "mine", *titles) == ["30.77", "1.5"]
    assert cells(text, "95 % interval", *titles) == ["0.0 to 61.5", "-"]
    assert cells(text, "published: GA-DDPG w/o hold", *titles) == ["23.60*", "0"]
    assert cells(text, "published: handover-sim2real", "wait s") == ["1.5"]
    assert cells(str(report(1, 2)), "mine", "wait s") == ["-"]


def test_intervals_of_times_are_in_seconds() -> None:
    """Intervals of two times are their range in seconds; the table has no interval of the total time."""
    found = Report(SETTINGS, (episode(0, 1, 4000, 0.25), episode(1, 1, 6000, 0.5)))
    titles = ("AS %", "exec s", "plan s", "total s")
    assert cells(str(found), "mine", *titles) == ["61.54", "5.000", "0.375", "5.375"]
    expected = ["53.8 to 69.2", "4.000 to 6.000", "0.250 to 0.500", "-"]
    assert cells(str(found), "95 % interval", *titles) == expected
    assert cells(str(found), "n", *titles) == ["2", "2", "2", "2"]


def test_notes_name_another_world_and_other_physics() -> None:
    assert "not the official ones" not in report(1).format_notes()
    assert "not the official ones (another)" in report(1, world="another").format_notes()
    assert "exact physics" in report(1, physics="fast").format_notes()
