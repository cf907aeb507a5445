"""Tests of the folder of a data set in LeRobot's format: resuming, workers, data cards and refused options."""

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.errors import OptionError, ResultsError, UnknownNameError
from handover_marl.evaluation.demonstrations.lerobot import writer
from tests.evaluation.demonstrations.lerobot.reading import data_set_contents, read_rows
from tests.evaluation.demonstrations.recording import SCENES, SHORT, MovingReceiver, record

pytest.importorskip("pyarrow")
pytest.importorskip("imageio_ffmpeg")
OPTIONS: dict[str, Any] = {"format": "lerobot", "giver": "noisy"}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an uninterrupted recording; do not write to it."""
    record(None, out := tmp_path_factory.mktemp("whole") / "out", **OPTIONS)
    return out


@pytest.fixture
def out(recorded: Path, tmp_path: Path) -> Path:
    """Return a copy of the recorded folder, which a test may change."""
    return Path(shutil.copytree(recorded, tmp_path / "copy"))


def test_data_do_not_depend_on_workers(recorded: Path, tmp_path: Path) -> None:
    record(None, tmp_path / "two", workers=2, **OPTIONS)
    assert data_set_contents(tmp_path / "two") == data_set_contents(recorded)
    assert sorted(data_set_contents(recorded)) == [
        "README.md",
        "data/chunk-000/file-000.parquet",
        "data/chunk-000/file-001.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/handover_marl.json",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]
    assert not list(recorded.glob(".*"))
    assert not (recorded / "episodes").exists()


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_recording_does_not_change_the_results(tmp_path: Path, physics: str) -> None:
    """Results equal those of an evaluation without recording, although frames are observed between decisions."""
    options: dict[str, Any] = {"scenes": [5], "physics": physics, "giver": "noisy"}
    record(None, tmp_path / "recorded", format="lerobot", obs_mode="state+pointcloud", **options)
    options |= {"receiver": MovingReceiver, "split": "train", "dataset": "synthetic", "world_config": SHORT}
    handover_marl.evaluate_pair(out=tmp_path / "plain", workers=1, progress=False, **options)
    with np.load(tmp_path / "plain" / "000.npz") as plain, np.load(tmp_path / "recorded" / "000.npz") as recorded:
        assert sorted(plain) == sorted(recorded)
        for key in set(plain) - {"elapsed_time"}:
            np.testing.assert_array_equal(plain[key], recorded[key], err_msg=key)


def test_further_scenes_are_inserted_in_the_order_of_the_split(
    recorded: Path, tmp_path: Path, played: list[int]
) -> None:
    record(None, tmp_path / "out", scenes=[105], **OPTIONS)
    record(None, tmp_path / "out", scenes=[5], **OPTIONS)
    summary = record(None, tmp_path / "out", **OPTIONS)
    assert played == [105, 5]
    assert data_set_contents(tmp_path / "out") == data_set_contents(recorded)
    assert (summary.n_episodes, summary.total_frames, summary.fps) == (2, 24, 20)  # type: ignore[attr-defined]
    assert "2 episodes with 24 frames at 20 fps of moving" in str(summary)


def test_videos_move_with_their_episodes(tmp_path: Path) -> None:
    options: dict[str, Any] = {"format": "lerobot", "fps": 5, "obs_mode": "rgbd"}
    record(None, tmp_path / "one", **options)
    for scene in (105, 5):
        record(None, tmp_path / "other", scenes=[scene], **options)
    assert data_set_contents(tmp_path / "one") == data_set_contents(tmp_path / "other")
    videos = [content for name, content in data_set_contents(tmp_path / "one").items() if name.endswith(".mp4")]
    assert len(set(videos)) == 2


def test_an_interrupted_recording_resumes(
    recorded: Path, tmp_path: Path, played: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(writer, "write_data_set", stop)
        with pytest.raises(KeyboardInterrupt):
            record(None, tmp_path / "out", **OPTIONS)
    assert sorted(path.name for path in (tmp_path / "out" / "episodes").iterdir()) == ["000.zip", "072.zip"]
    assert not list((tmp_path / "out").glob(".*"))
    assert not (tmp_path / "out" / "lerobot").exists()
    # The episode of a truncated file is simulated again.
    path = tmp_path / "out" / "episodes" / "072.zip"
    path.write_bytes(path.read_bytes()[:-100])
    record(None, tmp_path / "out", **OPTIONS)
    assert played == [*SCENES, SCENES[1]]
    assert data_set_contents(tmp_path / "out") == data_set_contents(recorded)


def test_a_replacement_that_was_killed_is_undone(out: Path, recorded: Path, played: list[int]) -> None:
    (out / ".lerobot.part.abc").mkdir()
    (out / "lerobot").rename(out / ".lerobot.previous")
    record(None, out, **OPTIONS)
    assert not played
    assert not list(out.glob(".*"))
    # The process was killed when the new data set was in place, but the previous one was not yet deleted.
    shutil.copytree(out / "lerobot", out / ".lerobot.previous")
    record(None, out, **OPTIONS)
    assert not list(out.glob(".*"))
    assert data_set_contents(out) == data_set_contents(recorded)


def test_damage_is_an_error(out: Path, played: list[int]) -> None:
    path = out / "lerobot" / "data" / "chunk-000" / "file-001.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=r"lerobot: an episode is damaged .*; remove it and run the same command"):
        record(None, out, scenes=[5, 10, 105], **OPTIONS)
    assert path.read_bytes() == content
    (out / "lerobot" / "meta" / "episodes" / "chunk-000" / "file-000.parquet").write_bytes(b"no table")
    played.clear()
    with pytest.raises(ResultsError, match="lerobot is damaged or no data set of this library"):
        record(None, out, **OPTIONS)
    shutil.rmtree(out / "lerobot")
    record(None, out, **OPTIONS)
    assert played == list(SCENES)


def test_other_files_are_not_deleted(out: Path, played: list[int]) -> None:
    (out / "lerobot" / "notes.txt").write_text("precious")
    for options in ({}, {"fresh": True}):
        with pytest.raises(ResultsError, match=r"has other files: notes\.txt; move them"):
            record(None, out, **OPTIONS, **options)
    assert not played
    (out / "lerobot" / "notes.txt").unlink()
    record(None, out, seed=1, scenes=[5], fresh=True, **OPTIONS)
    assert [(row["scene_id"], row["seed"]) for row in read_rows(out)] == [(5, 1)]


def test_formats_do_not_mix(out: Path) -> None:
    for options in ({"giver": "noisy"}, {**OPTIONS, "fps": 10}):
        with pytest.raises(ResultsError, match="holds another evaluation"):
            record(None, out, **options)


def test_a_data_set_without_episodes(tmp_path: Path) -> None:
    for _ in range(2):
        summary = record(None, tmp_path / "out", format="lerobot", keep="success", scenes=[5])
        assert "0 episodes with 0 frames" in str(summary)
    assert set(data_set_contents(tmp_path / "out")) == {
        "README.md",
        "meta/handover_marl.json",
        "meta/info.json",
        "meta/stats.json",
    }


def test_impossible_options_are_refused_before_the_first_scene(
    tmp_path: Path, played: list[int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for error, match, options in (
        (UnknownNameError, "unknown format 'zarr'; valid: minari, lerobot", {"format": "zarr"}),
        (OptionError, "fps must be left out with format='minari', got 20", {"fps": 20}),
        (OptionError, "fps must be an integer from 1 to 1000, got 0", {"format": "lerobot", "fps": 0}),
        (OptionError, "fps must be an integer from 1 to 1000, got 29.97", {"format": "lerobot", "fps": 29.97}),
        (OptionError, "shard must be left out with format='lerobot', got '1/2'", {"format": "lerobot", "shard": "1/2"}),
    ):
        with pytest.raises(error, match=match):
            record(None, tmp_path / "out", **options)
    assert main(["demonstrate", "--fps", "20", "--dataset", "synthetic", "--out", str(tmp_path / "out")]) == 2
    assert "fps must be left out" in capsys.readouterr().err
    found = importlib.util.find_spec
    for module in ("pyarrow", "imageio_ffmpeg"):
        with monkeypatch.context() as patch:
            patch.setattr(importlib.util, "find_spec", lambda name, m=module: None if name == m else found(name))
            with pytest.raises(OptionError, match=rf"needs {module}: pip install 'handover-marl\[lerobot\]'"):
                record(None, tmp_path / "out", format="lerobot")
    assert not played
    assert not (tmp_path / "out").exists()


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demonstrate", "--receiver", "hold", "--physics", "fast", "--dataset", "synthetic", "--scenes", "5"]
    command += ["--format", "lerobot", "--fps", "2", "--out", str(tmp_path / "out"), "--no-progress", "--workers", "1"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "1 episodes with 26 frames at 2 fps of hold, giver replay, synthetic, s0 train, fast physics" in printed
    assert f"Report: {tmp_path / 'out' / 'report.html'}" in printed
    card = (tmp_path / "out" / "lerobot" / "README.md").read_text()
    (line,) = [line for line in card.splitlines() if line.startswith("handover-marl")]
    assert line == (
        "handover-marl demonstrate --receiver hold --dataset synthetic --setup s0 --split train --physics fast "
        "--obs-mode state --scenes 5 --format lerobot --fps 2 --out DIR"
    )
