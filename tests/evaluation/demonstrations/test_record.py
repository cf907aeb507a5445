"""Tests of the folder of a recording: resuming, workers, selection of episodes and refused options."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import Demonstrations
from handover_marl.cli import main
from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.errors import OptionError, UnknownNameError
from tests.evaluation.demonstrations.recording import HORIZON, SCENES, SHORT, MovingReceiver, contents, record

REPOSITORY = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def whole(fake_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the content of the files of an uninterrupted recording."""
    record(fake_data, out := tmp_path_factory.mktemp("whole") / "out")
    return contents(out)


@pytest.mark.slow
def test_data_do_not_depend_on_workers(tmp_path: Path) -> None:
    options: dict[str, Any] = {"giver": "noisy", "obs_mode": "state+pointcloud"}
    for workers in (1, 2):
        record(None, tmp_path / str(workers), workers=workers, **options)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert sorted(contents(tmp_path / "1")) == ["000.npz", "072.npz", "metadata.json"]


@pytest.mark.slow
def test_damaged_and_missing_episodes_are_simulated_again(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    out = tmp_path / "out"
    for scene in (105, 5):
        record(fake_data, out, scenes=[scene])
    assert contents(out) == whole
    path = out / "demonstrations" / "072.npz"
    # The last file is an undamaged recording of another scene.
    for damage in (b"", b"no archive", whole["072.npz"][:-100], None, whole["000.npz"]):
        path.unlink() if damage is None else path.write_bytes(damage)
        played.clear()
        record(fake_data, out)
        assert played == [105]
        assert contents(out) == whole


@pytest.mark.slow
@pytest.mark.parametrize(("physics", "fps"), [("fast", None), ("exact", 20)])
def test_recording_does_not_change_the_results(tmp_path: Path, physics: str, fps: int | None) -> None:
    """Results equal those of an evaluation without recording, although frames are observed between decisions."""
    options: dict[str, Any] = {"scenes": [5], "physics": physics, "giver": "noisy"}
    record(None, tmp_path / "recorded", obs_mode="state+pointcloud", fps=fps, **options)
    options |= {"receiver": MovingReceiver, "split": "train", "dataset": "synthetic", "world_config": SHORT}
    handover_marl.evaluate_pair(out=tmp_path / "plain", workers=1, progress=False, **options)
    with np.load(tmp_path / "plain" / "000.npz") as plain, np.load(tmp_path / "recorded" / "000.npz") as recorded:
        assert sorted(plain) == sorted(recorded)
        for key in set(plain) - {"elapsed_time"}:
            np.testing.assert_array_equal(plain[key], recorded[key], err_msg=key)


@pytest.mark.slow
def test_frames_are_those_of_the_nearest_step(tmp_path: Path) -> None:
    """Frames at 30 per second, which fall between physics steps, equal those of a recording of every step."""
    options: dict[str, Any] = {"giver": "noisy", "scenes": SCENES[:1]}
    (decisions,), (frames,), (every,) = (
        record(None, tmp_path / str(fps), fps=fps, **options) for fps in (None, 30, 1000)
    )
    nearest = np.rint(np.arange(18) * 1000.0 / 30).astype(int)
    np.testing.assert_array_equal(frames.steps, [*nearest, HORIZON])
    np.testing.assert_array_equal(every.steps, np.arange(HORIZON + 1))
    for name, array in frames.observations.items():
        np.testing.assert_array_equal(array, every.observations[name][frames.steps], err_msg=name)
        np.testing.assert_array_equal(decisions.observations[name], every.observations[name][decisions.steps])
    # The receiver's actions hold until its next decision, and so do the giver's.
    np.testing.assert_array_equal(every.actions, np.repeat(decisions.actions, np.diff(decisions.steps), axis=0))
    np.testing.assert_array_equal(frames.actions, every.actions[nearest])
    for demonstration in (frames, every):
        np.testing.assert_array_equal(demonstration.giver_actions, decisions.giver_actions)
    held = every.hold_giver_actions()
    np.testing.assert_array_equal(held[decisions.giver_steps], decisions.giver_actions)
    assert len(np.unique(held, axis=0)) == len(np.unique(decisions.giver_actions, axis=0)) > 3
    assert (decisions.metadata, decisions.truncations[-1]) == (frames.metadata, frames.truncations[-1])


@pytest.mark.slow
def test_only_successes_and_then_all(tmp_path: Path, played: list[int]) -> None:
    """Episodes that `keep` excluded are simulated again only if a later recording includes them."""
    options: dict[str, Any] = {"receiver": "yang2021:wait=0", "world_config": OFFICIAL_CONFIG, "scenes": [5, 10]}
    some = record(None, tmp_path / "out", keep="success", **options)
    outcomes = [metadata["outcome"] for metadata in some.read_metadata()]
    assert (played, outcomes) == ([5, 10], ["success"])
    assert "Simulated: 2 (" in str(some)
    before = contents(tmp_path / "out")
    record(None, tmp_path / "out", keep="success", **options)
    assert len(played) == 2, "what is not kept is not played again"
    assert contents(tmp_path / "out") == before
    every = record(None, tmp_path / "out", **options)
    assert played == [5, 10, 10]
    assert sorted(metadata["outcome"] == "success" for metadata in every.read_metadata()) == [False, True]
    record(None, tmp_path / "out", keep="success", **options)
    assert contents(tmp_path / "out") == before


def test_a_recording_without_episodes(fake_data: Path, tmp_path: Path) -> None:
    nothing = record(fake_data, tmp_path / "out", keep="success", scenes=[5])
    assert (len(nothing), nothing.read_metadata(), list(nothing)) == (0, [], [])
    assert nothing.read_transitions(["time"])[1].shape == (0, 9)
    assert "0 episodes of moving" in str(nothing)
    assert "Simulated: 1 (timeout 1)" in str(nothing)


@pytest.mark.parametrize(
    ("error", "match", "options"),
    [
        (OptionError, "need an output folder", {"out": None}),
        (UnknownNameError, "unknown keep 'some'; valid: all, success", {"keep": "some"}),
        (UnknownNameError, "unknown obs_mode 'sonar'", {"obs_mode": "sonar"}),
        (UnknownNameError, "unknown split", {"split": "later"}),
        (OptionError, "split must be 'train', got 'val'", {"split": "val"}),
        (UnknownNameError, "unknown renderer", {"renderer": "x", "obs_mode": "state+pointcloud"}),
        (OptionError, "fps must be an integer from 1 to 1000, got 0", {"fps": 0}),
        (OptionError, "fps must be an integer from 1 to 1000, got 29.97", {"fps": 29.97}),
    ],
)
def test_impossible_recordings_are_refused(
    fake_data: Path, tmp_path: Path, error: type[Exception], match: str, options: dict[str, Any]
) -> None:
    with pytest.raises(error, match=match):
        record(fake_data, **{"out": tmp_path / "out", **options})
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command(fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demonstrate", "--receiver", "hold", "--physics", "fast", "--scenes", "5", "--data-dir", str(fake_data)]
    assert main(command) == 2
    assert "need an output folder; pass out= (--out DIR)" in capsys.readouterr().err
    command += ["--fps", "2", "--out", str(tmp_path / "out"), "--no-progress", "--workers", "1"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "1 episodes of hold, giver replay, dexycb, s0 train, fast physics; demonstrations, 2 fps" in printed.out
    assert "Simulated: 1 (timeout 1)" in printed.out
    assert f"Report: {tmp_path / 'out' / 'report.html'}" in printed.out
    assert not printed.err
    assert len(Demonstrations(tmp_path / "out")[0]) == 26
    assert main(["evaluate", str(tmp_path / "out")]) == 0
    assert "1 of 720 scenes (partial)" in capsys.readouterr().out
