import json

import pytest

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.settings import RunSettings
from handover_marl.protocol.status import EpisodeStatus

SETTINGS = RunSettings("s0", "test", "mine", "replay", "exact", "dexycb", "0.1.0")


def episode(index: int, status: int, steps: int = 5000, plan: float = 0.1, **extras: object) -> EpisodeResult:
    named = {"scene_id": 204 + 5 * index, "object_name": "003_cracker_box", "n_objects": 1, "machine": "a machine"}
    return EpisodeResult(index, EpisodeStatus(status), steps, plan, **{**named, **extras})


def report(*statuses: int, **settings: str) -> Report:
    episodes = tuple(episode(index, status) for index, status in enumerate(statuses))
    return Report(RunSettings(**{**SETTINGS.__dict__, **settings}), episodes, 144)


def test_official_metrics() -> None:
    episodes = (
        episode(0, 1, 4000, 0.2),
        episode(1, 1, 6000, 0.4),
        episode(2, 2, 100, 9.0),
        episode(3, 2 | 4, 200, 9.0),
        episode(4, 8, 13000, 9.0),
    )
    found = Report(SETTINGS, episodes, 144)
    assert (found.success_rate, found.contact_rate, found.drop_rate, found.timeout_rate) == (0.4, 0.4, 0.2, 0.2)
    assert found.time_exec == pytest.approx(5.0)
    assert found.time_plan == pytest.approx(0.3)
    assert found.time_total == pytest.approx(5.3)


def test_no_success_prints_dashes_and_json_has_null() -> None:
    found = report(2, 4, 8)
    assert found.time_exec is found.time_plan is found.time_total is None
    row = next(line for line in str(found).splitlines() if line.startswith("| mine"))
    assert [cell.strip() for cell in row.split("|")[2:6]] == ["0.00 (0/3)", "-", "-", "-"]
    assert "nan" not in str(found).lower()
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["times"]["exec"]["mean"] is None


def test_text_says_what_was_run() -> None:
    text = str(report(1, 2))
    for word in ("s0 test", "2 of 144 scenes (partial)", "mine", "replay", "exact", "DexYCB, grasped object only"):
        assert word in text
    assert "published: Yang et al." in text
    assert "a machine" in text


@pytest.mark.parametrize("settings", [{"split": "val"}, {"dataset": "synthetic"}, {"physics": "fast"}])
def test_published_rows_only_beside_what_they_compare_with(settings: dict[str, str]) -> None:
    assert "published:" not in str(report(1, 2, **settings))


def test_breakdown_by_object() -> None:
    episodes = (episode(0, 1), episode(1, 2, object_name="025_mug"), episode(2, 4, object_name="025_mug"))
    lines = str(Report(SETTINGS, episodes, 144)).splitlines()
    mug = next(line for line in lines if "025_mug" in line)
    assert [cell.strip() for cell in mug.split("|")[2:7]] == ["2", "0", "1", "1", "0"]
