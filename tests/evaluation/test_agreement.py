from pathlib import Path

import pytest

from handover_marl.cli import main
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import UnknownNameError
from handover_marl.evaluation.comparison import Agreement, compare_physics
from handover_marl.evaluation.metadata import ResultMetadata
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.results import EpisodeResult

SUCCESS, CONTACT, DROP = EpisodeStatus.SUCCESS, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP


def report(physics: str, ends: list[tuple[EpisodeStatus, int]]) -> Report:
    settings = ResultMetadata("s0", "val", "mine", "replay", physics, "dexycb", "0")
    episodes = tuple(
        EpisodeResult(index, status, steps, 0.0, scene_id=100 + index, object_name="024_bowl", n_objects=1)
        for index, (status, steps) in enumerate(ends)
    )
    return Report(settings, episodes)


@pytest.fixture
def example() -> Agreement:
    exact = report("exact", [(SUCCESS, 4000), (CONTACT, 3500), (DROP, 4100), (SUCCESS, 4200)])
    fast = report("fast", [(SUCCESS, 4003), (CONTACT, 3500), (SUCCESS, 4900), (SUCCESS, 4199)])
    return Agreement(exact, fast)


def test_text_of_an_agreement(example: Agreement) -> None:
    text = str(example)
    assert "3 of 4 scenes: 75.00 % (95 % interval 30.1 to 95.4)" in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "|" in line]
    assert ["exact: drop", "0", "0", "1"] in rows
    assert ["metric", "fast %", "exact %", "fast minus exact, points", "n episodes"] in rows
    (rates,) = [row for row in rows if row[0] == "success"]
    assert [cell.split()[0] for cell in rates] == ["success", "75.00", "50.00", "+25.00", "4"]
    assert ["102", "024_bowl", "drop", "success", "4100", "4900"] in rows
    assert ["102", "024_bowl", "-", "-"] in rows
    assert not any(row[0] in ("100", "101", "103") for row in rows), "agreeing scenes are not listed"
    assert "differ by 1 in the median" in text
    assert "3 at most" in text


def test_command(fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["agreement", "--receiver", "hold", "--scenes", "9", "--workers", "1"]
    assert main([*command, "--data-dir", str(fake_data), "--out", str(out)]) == 0
    assert "1 of 1 scenes: 100.00 %" in capsys.readouterr().out
    assert (out / "agreement.md").read_text().startswith("# Exact and fast physics")
    assert {path.name for path in (out / "fast").glob("*.npz")} == {path.name for path in (out / "exact").glob("*.npz")}


def test_any_physics_but_exact_can_be_compared(fake_data: Path) -> None:
    with pytest.raises(UnknownNameError, match="valid: fast, mujoco"):
        compare_physics(scenes=[9], data_dir=fake_data, against="exact")
