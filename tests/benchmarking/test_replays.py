"""Replays of a benchmark's episodes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.benchmarking import playing
from handover_marl.benchmarking.replay_shelf import replay_shelves
from handover_marl.benchmarking.results import ResultFolder, read_results
from handover_marl.benchmarking.settings import read_settings
from handover_marl.errors import OptionError, ResultsError, UnknownNameError
from handover_marl.run import Execution
from tests.benchmarking.quick import HORIZON, SHORT, run, untimed
from tests.benchmarking.test_report import episode
from tests.pages.outside import outside, references

pytest.importorskip("viser", reason="needs the extra `replay`")
pytest.importorskip("fast_simplification", reason="needs the extra `replay`")


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The scenes that are played."""
    scenes, play = [], playing.play

    def noted(episode: Any, *players: Any, **options: Any) -> None:
        scenes.append(episode.scene.info.scene_id)
        play(episode, *players, **options)

    monkeypatch.setattr(playing, "play", noted)
    return scenes


def replays(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "episodes").iterdir())


def test_failed_episodes_of_a_finished_run_are_played_again_once(
    fake_data: Path, tmp_path: Path, played: list[int]
) -> None:
    plain = run(fake_data, tmp_path)
    assert "--replays failed" in (tmp_path / "report.html").read_text()
    with_replays = run(fake_data, tmp_path, replays="failed")
    assert untimed(with_replays) == untimed(plain)
    assert played == [9, 14, 9, 14]
    assert replays(tmp_path) == ["009.html", "014.html"]
    links = references((tmp_path / "report.html").read_text())
    assert "#timeout" in links
    assert {"episodes/009.html", "episodes/014.html"} <= set(links)
    for name in replays(tmp_path):
        page = (tmp_path / "episodes" / name).read_text()
        assert f"scene {int(name[:3])}, timeout, {HORIZON} steps" in page[:1000]
        assert outside(page) == []
        assert len(page.encode()) < 3_000_000
    (tmp_path / "episodes" / "009.html").unlink()
    (tmp_path / "episodes" / "014.html").write_text("<!doctype html>scene 14, contact, 99 steps")
    run(fake_data, tmp_path, replays="failed")
    assert run(fake_data, tmp_path, replays="failed").n_earlier == 2
    assert played == [9, 14] * 3
    assert "timeout" in (tmp_path / "episodes" / "014.html").read_text()[:1000]
    # Whoever wants none any more loses none; a fresh run begins without.
    run(fake_data, tmp_path, scenes=[9], fresh=True)
    assert replays(tmp_path) == []


def test_what_ends_otherwise_is_not_the_same_episode(fake_data: Path, tmp_path: Path) -> None:
    run(fake_data, tmp_path, scenes=[9])
    (result,) = read_results(tmp_path)
    folder = ResultFolder(tmp_path, read_settings(tmp_path), SHORT)
    with np.load(tmp_path / "000.npz") as archive:
        actions, times = archive["action"][:-1], archive["elapsed_time"][:-1]
    folder.save(replace(result, steps=HORIZON - 1), actions, times)
    before = (tmp_path / "000.npz").read_bytes()
    with pytest.raises(ResultsError, match=rf"scene 9 ended otherwise .*{HORIZON - 1} steps.*{HORIZON} steps"):
        run(fake_data, tmp_path, scenes=[9], replays="failed")
    assert (tmp_path / "000.npz").read_bytes() == before
    assert replays(tmp_path) == []


@pytest.mark.slow
def test_workers_make_them_too(fake_data: Path, tmp_path: Path) -> None:
    run(fake_data, tmp_path, replays="all", workers=2)
    assert replays(tmp_path) == ["009.html", "014.html"]


def test_which_episodes(tmp_path: Path) -> None:
    for wanted, success_is_there in (("failed", True), ("all", False)):
        (shelf,) = replay_shelves(Execution(out=str(tmp_path), replays=wanted))
        shelf.open(tmp_path, None, False)  # type: ignore[arg-type]
        assert shelf.has(episode(0, 1)) is success_is_there
        assert shelf.has(episode(0, 4)) is False
    assert replay_shelves(Execution(out=str(tmp_path))) == []
    with pytest.raises(UnknownNameError, match="replays 'some'"):
        replay_shelves(Execution(out=str(tmp_path), replays="some"))
    with pytest.raises(OptionError, match="need a folder"):
        replay_shelves(Execution(replays="failed"))
