"""Tests of the folder of a recording: resuming, workers, selection of episodes and refused options."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import Demonstrations
from handover_marl.cli import main
from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.errors import OptionError, ResultsError, UnknownNameError
from handover_marl.evaluation.demonstrations.demonstration import hold_actions
from handover_marl.evaluation.demonstrations.record import compute_frame_step
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


KILLED = """
import sys, time
from pathlib import Path
from handover_marl.evaluation.episode_runner import EpisodeRunner
from tests.evaluation.demonstrations.recording import record

simulate = EpisodeRunner.run

def slowly(player, task):
    if task.scene_id != 5:
        time.sleep(100.0)
    return simulate(player, task)

EpisodeRunner.run = slowly
record(Path(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.mark.slow
def test_a_killed_recording_resumes(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    out = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(fake_data), str(out)], cwd=REPOSITORY)
    until = time.monotonic() + 60.0
    while not list(out.glob("*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert [metadata.scene_id for metadata in Demonstrations(out).read_metadata()] == [5]
    # A process that is killed while it writes leaves such a file.
    (out / "demonstrations" / ".072.npz.abcd1234.part").write_bytes(b"half")
    record(fake_data, out)
    assert played == [105]
    assert contents(out) == whole


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


def test_frame_steps() -> None:
    assert [compute_frame_step(number, 20) for number in range(4)] == [0, 50, 100, 150]
    assert [compute_frame_step(number, 30) for number in range(4)] == [0, 33, 67, 100]
    # If two steps are equally near, the later one is used.
    assert compute_frame_step(1, 400) == 3


def test_actions_are_held() -> None:
    decisions = [(0, np.zeros(1, np.float32)), (50, np.ones(1, np.float32))]
    assert hold_actions(decisions, np.array([0, 49, 50, 99])).ravel().tolist() == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.slow
def test_only_successes_and_then_all(tmp_path: Path, played: list[int]) -> None:
    """Episodes that `keep` excluded are simulated again only if a later recording includes them."""
    options: dict[str, Any] = {"receiver": "yang2021:wait=0", "world_config": OFFICIAL_CONFIG, "scenes": [5, 10]}
    some = record(None, tmp_path / "out", keep="success", **options)
    outcomes = [metadata.outcome for metadata in some.read_metadata()]
    assert (played, outcomes) == ([5, 10], ["success"])
    assert "Simulated: 2 (" in str(some)
    before = contents(tmp_path / "out")
    record(None, tmp_path / "out", keep="success", **options)
    assert len(played) == 2, "what is not kept is not played again"
    assert contents(tmp_path / "out") == before
    every = record(None, tmp_path / "out", **options)
    assert played == [5, 10, 10]
    assert sorted(metadata.success for metadata in every.read_metadata()) == [False, True]
    record(None, tmp_path / "out", keep="success", **options)
    assert contents(tmp_path / "out") == before


def test_a_recording_without_episodes(fake_data: Path, tmp_path: Path) -> None:
    nothing = record(fake_data, tmp_path / "out", keep="success", scenes=[5])
    assert (len(nothing), nothing.read_metadata(), list(nothing)) == (0, [], [])
    assert nothing.read_transitions(["time"])[1].shape == (0, 9)
    assert "0 episodes of moving" in str(nothing)
    assert "Simulated: 1 (timeout 1)" in str(nothing)


@pytest.mark.parametrize("split", ["val", "test"])
def test_other_splits_are_refused(
    fake_data: Path, tmp_path: Path, split: str, capsys: pytest.CaptureFixture[str]
) -> None:
    why = f"split must be 'train', got '{split}'"
    with pytest.raises(OptionError, match=why):
        record(fake_data, tmp_path / "out", split=split)
    with pytest.raises(OptionError, match=why):
        handover_marl.demonstrate(handover_marl.EvaluationConfig(split=split), out=tmp_path / "out")
    assert main(["demonstrate", "--split", split, "--out", str(tmp_path / "out"), "--data-dir", str(fake_data)]) == 2
    assert why in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "match", "options"),
    [
        (OptionError, "need an output folder", {"out": None}),
        (UnknownNameError, "unknown keep 'some'; valid: all, success", {"keep": "some"}),
        (UnknownNameError, "unknown obs_mode 'sonar'", {"obs_mode": "sonar"}),
        (UnknownNameError, "unknown split", {"split": "later"}),
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
def test_other_folders_are_unchanged(fake_data: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("precious")
    with pytest.raises(ResultsError, match="is no result folder"):
        record(fake_data, foreign)
    assert [path.name for path in foreign.iterdir()] == ["thesis.txt"]
    record(fake_data, tmp_path / "out", scenes=[5])
    before = contents(tmp_path / "out")
    for other in ({"obs_mode": "state+pointcloud"}, {"seed": 1}, {"giver": "noisy"}, {"physics": "exact"}, {"fps": 9}):
        with pytest.raises(ResultsError, match="holds another evaluation"):
            record(fake_data, tmp_path / "out", scenes=[5], **other)
    run: dict[str, Any] = {"receiver": MovingReceiver, "split": "train", "scenes": [5], "world_config": SHORT}
    run |= {"data_dir": fake_data, "physics": "fast", "progress": False, "workers": 1}
    with pytest.raises(ResultsError, match="recorded 'demonstrations, obs_mode state' in the folder, '' now"):
        handover_marl.evaluate_pair("replay", out=tmp_path / "out", **run)
    assert contents(tmp_path / "out") == before
    handover_marl.evaluate_pair("replay", out=tmp_path / "plain", **run)
    with pytest.raises(ResultsError, match="recorded '' in the folder"):
        record(fake_data, tmp_path / "plain", scenes=[5])


@pytest.mark.slow
def test_fresh_deletes_earlier_recordings(fake_data: Path, tmp_path: Path) -> None:
    record(fake_data, tmp_path / "out")
    (tmp_path / "out" / "demonstrations" / "notes.txt").write_text("precious")
    anew = record(fake_data, tmp_path / "out", seed=1, scenes=[5], fresh=True)
    assert [(metadata.scene_id, metadata.seed) for metadata in anew.read_metadata()] == [(5, 1)]
    assert (tmp_path / "out" / "demonstrations" / "notes.txt").read_text() == "precious"
    run: dict[str, Any] = {"split": "train", "scenes": [5], "world_config": SHORT, "data_dir": fake_data}
    run |= {"physics": "fast", "progress": False, "workers": 1}
    handover_marl.evaluate_pair("replay", "hold", out=tmp_path / "out", fresh=True, **run)
    assert [path.name for path in (tmp_path / "out" / "demonstrations").iterdir()] == ["notes.txt"]


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
