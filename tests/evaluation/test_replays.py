"""Tests of the replay pages of evaluated episodes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.errors import OptionError, ResultsError, UnknownNameError
from handover_marl.evaluation.metadata import read_result_metadata
from handover_marl.evaluation.recordings import ReplayWriter
from handover_marl.evaluation.results import ResultFolder, encode_result, read_results
from tests.evaluation.quick import HORIZON, run, untimed
from tests.evaluation.reports.test_report import episode
from tests.visualization.outside import outside, references

pytest.importorskip("viser", reason="needs the extra `replay`")
pytest.importorskip("fast_simplification", reason="needs the extra `replay`")


def replays(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "episodes").iterdir())


@pytest.mark.slow
def test_failed_episodes_of_a_finished_run_are_simulated_again_once(
    fake_data: Path, tmp_path: Path, played: list[int]
) -> None:
    plain = run(fake_data, tmp_path)
    assert "--replays failed" in (tmp_path / "report.html").read_text()
    with_replays = run(fake_data, tmp_path, replays="failed")
    assert untimed(with_replays) == untimed(plain)
    assert played == [9, 14, 9, 14]
    assert replays(tmp_path) == ["009.html", "014.html"]
    links = references((tmp_path / "report.html").read_text())
    assert {"#timeout", "episodes/009.html", "episodes/014.html"} <= set(links)
    page = (tmp_path / "episodes" / "009.html").read_text()
    assert f"scene 9, timeout, {HORIZON} steps" in page[:1000]
    assert outside(page) == []
    (tmp_path / "episodes" / "009.html").unlink()
    run(fake_data, tmp_path, replays="failed")
    assert run(fake_data, tmp_path, replays="failed").n_resumed == 2
    assert played == [9, 14, 9, 14, 9]
    # A fresh run deletes the replays.
    run(fake_data, tmp_path, scenes=[9], overwrite=True)
    assert replays(tmp_path) == []


@pytest.mark.slow
def test_another_outcome_on_replay_is_an_error(fake_data: Path, tmp_path: Path) -> None:
    run(fake_data, tmp_path, scenes=[9])
    (result,) = read_results(tmp_path)
    folder = ResultFolder(tmp_path, read_result_metadata(tmp_path))
    with np.load(tmp_path / "000.npz") as archive:
        actions, times = archive["action"][:-1], archive["elapsed_time"][:-1]
    changed = replace(result, steps=HORIZON - 1)
    folder.write(changed, encode_result(changed, actions, times))
    before = (tmp_path / "000.npz").read_bytes()
    with pytest.raises(
        ResultsError, match=rf"replaying scene 9 gave another outcome .*{HORIZON - 1} steps.*{HORIZON} steps"
    ):
        run(fake_data, tmp_path, scenes=[9], replays="failed")
    assert (tmp_path / "000.npz").read_bytes() == before
    assert replays(tmp_path) == []


def test_replays_of_failed_or_all_episodes(tmp_path: Path) -> None:
    for wanted, success_is_there in (("failed", True), ("all", False)):
        writer = ReplayWriter(tmp_path, wanted)
        assert [writer.contains(episode(0, status)) for status in (1, 4)] == [success_is_there, False]
    with pytest.raises(UnknownNameError, match="replays 'some'"):
        run(tmp_path, tmp_path, replays="some")
    with pytest.raises(OptionError, match="need an output folder"):
        run(tmp_path, replays="failed")
