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
from handover_marl.errors import DataNotFoundError, OptionError, ResultsError, UnknownNameError
from handover_marl.evaluation.demonstrations import files as hdf5
from handover_marl.evaluation.demonstrations import join, writer
from tests.evaluation.demonstrations.recording import (
    SCENES,
    SHORT,
    MovingReceiver,
    assert_same,
    contents,
    main_file,
    record,
)

REPOSITORY = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def whole(fake_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the content of the files of an uninterrupted recording."""
    record(fake_data, out := tmp_path_factory.mktemp("whole") / "out")
    return contents(out)


def test_data_do_not_depend_on_workers(tmp_path: Path) -> None:
    options: dict[str, Any] = {"giver": "noisy", "obs_mode": "state+pointcloud"}
    for workers in (1, 2):
        record(None, tmp_path / str(workers), workers=workers, **options)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert sorted(contents(tmp_path / "1")) == ["README.md", "main_data.hdf5", "metadata.json"]
    assert not (tmp_path / "1" / "episodes").exists()
    card = contents(tmp_path / "1")["README.md"].decode()
    for key in Demonstrations(tmp_path / "1").observation_space:
        assert f"| `observations/{key}` | (" in card
    assert "| timeout   |           2 |          2 |" in card
    assert "--giver noisy --dataset synthetic" in card


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
    assert [path.name for path in (out / "episodes").iterdir()] == ["000.hdf5"]
    with pytest.raises(DataNotFoundError, match="not finished"):
        Demonstrations(out)
    # A process that is killed while it writes leaves such a file.
    (out / "data" / ".main_data.hdf5.abcd1234.part").write_bytes(b"half")
    record(fake_data, out)
    assert played == [105]
    assert contents(out) == whole


def test_a_recording_interrupted_during_assembly_resumes(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    for module, name in ((join, "_copy_episodes"), (join, "format_metadata")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, name, stopped)
            with pytest.raises(KeyboardInterrupt):
                record(fake_data, tmp_path / "out")
        assert not list((tmp_path / "out" / "data").glob(".*"))
    record(fake_data, tmp_path / "out")
    assert played == list(SCENES)
    assert contents(tmp_path / "out") == whole


def test_further_scenes_are_inserted_in_the_order_of_the_split(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    record(fake_data, tmp_path / "out", scenes=[105])
    record(fake_data, tmp_path / "out", scenes=[5])
    again = record(fake_data, tmp_path / "out", scenes=[5, 105])
    assert played == [105, 5]
    assert [metadata.scene_id for metadata in again.read_metadata()] == [5, 105]
    assert contents(tmp_path / "out") == whole


def test_recording_does_not_change_the_results(tmp_path: Path) -> None:
    record(None, tmp_path / "recorded", obs_mode="state+pointcloud", giver="noisy")
    run: dict[str, Any] = {"receiver": MovingReceiver, "split": "train", "scenes": SCENES, "world_config": SHORT}
    run |= {"dataset": "synthetic", "physics": "fast", "progress": False, "workers": 1, "out": tmp_path / "plain"}
    handover_marl.evaluate_pair("noisy", **run)
    files = sorted(path.name for path in (tmp_path / "plain").glob("*.npz"))
    assert len(files) == 2
    for name in files:
        with np.load(tmp_path / "plain" / name) as plain, np.load(tmp_path / "recorded" / name) as recorded:
            assert sorted(plain) == sorted(recorded)
            for key in set(plain) - {"elapsed_time"}:
                np.testing.assert_array_equal(plain[key], recorded[key], err_msg=key)


def test_one_recording_at_a_time(fake_data: Path, tmp_path: Path, played: list[int]) -> None:
    out = tmp_path / "out"
    record(fake_data, out, scenes=SCENES[:1])
    code = (
        "import pathlib, sys; from handover_marl.execution.files import exclusive_lock\n"
        "with exclusive_lock(pathlib.Path(sys.argv[1])): print('in', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(out / "data")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "in\n"
        with pytest.raises(ResultsError, match=r"another process is writing to .*; wait for it, or choose another"):
            record(fake_data, out)
        assert played == list(SCENES[:1])
        other.communicate()
    assert len(record(fake_data, out)) == len(SCENES)


def test_only_successes_and_then_all(tmp_path: Path, played: list[int]) -> None:
    """Episodes that `keep` excluded are simulated again only if a later recording includes them."""
    options: dict[str, Any] = {"receiver": "yang2021:wait=0", "world_config": OFFICIAL_CONFIG, "scenes": [5, 10]}
    some = record(None, tmp_path / "out", keep="success", **options)
    outcomes = [metadata.outcome for metadata in some.read_metadata()]
    assert (played, outcomes) == ([5, 10], ["success"])
    assert "Simulated: 2 (" in str(some)
    again = record(None, tmp_path / "out", keep="success", **options)
    assert len(played) == 2, "what is not kept is not played again"
    assert_same(some[0], again[0])
    every = record(None, tmp_path / "out", **options)
    assert played == [5, 10, 10]
    assert sorted(metadata.success for metadata in every.read_metadata()) == [False, True]
    assert len(record(None, tmp_path / "out", keep="success", **options)) == 1


def test_a_data_set_without_episodes(fake_data: Path, tmp_path: Path) -> None:
    for _ in range(2):
        nothing = record(fake_data, tmp_path / "out", keep="success", scenes=[5])
        assert (len(nothing), nothing.read_metadata(), list(nothing)) == (0, [], [])
        assert nothing.read_transitions(["time"])[1].shape == (0, 9)
    assert "0 episodes with 0 decisions" in str(nothing)
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


def test_impossible_recordings_are_reported_before_the_first_scene(
    fake_data: Path, tmp_path: Path, played: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, match, options in (
        (OptionError, "need an output folder", {"out": None}),
        (UnknownNameError, "unknown keep 'some'; valid: all, success", {"keep": "some"}),
        (UnknownNameError, "unknown obs_mode 'sonar'", {"obs_mode": "sonar"}),
        (UnknownNameError, "unknown split", {"split": "later"}),
        (UnknownNameError, "unknown renderer", {"renderer": "x", "obs_mode": "state+pointcloud"}),
    ):
        with pytest.raises(error, match=match):
            record(fake_data, **{"out": tmp_path / "out", **options})
    monkeypatch.setattr(hdf5.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"needs h5py: pip install 'handover-marl\[demonstrations\]'"):
        record(fake_data, tmp_path / "out")
    assert not played
    assert not (tmp_path / "out").exists()


def test_other_folders_are_unchanged(fake_data: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("precious")
    with pytest.raises(ResultsError, match="is no result folder"):
        record(fake_data, foreign)
    assert [path.name for path in foreign.iterdir()] == ["thesis.txt"]
    record(fake_data, tmp_path / "out", scenes=[5])
    before = contents(tmp_path / "out")
    for other in ({"obs_mode": "state+pointcloud"}, {"seed": 1}, {"giver": "noisy"}, {"physics": "exact"}):
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


def test_fresh_deletes_earlier_recordings(fake_data: Path, tmp_path: Path, played: list[int]) -> None:
    record(fake_data, tmp_path / "out")
    (tmp_path / "out" / "data" / "notes.txt").write_text("precious")
    anew = record(fake_data, tmp_path / "out", seed=1, scenes=[5], fresh=True)
    assert played == [5, 105, 5]
    assert [(metadata.scene_id, metadata.seed) for metadata in anew.read_metadata()] == [(5, 1)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer.DemonstrationWriter, "assemble", lambda self: None)
        with pytest.raises(DataNotFoundError, match="not finished"):
            record(fake_data, tmp_path / "out", scenes=[5], fresh=True)
    assert (tmp_path / "out" / "data" / "notes.txt").read_text() == "precious"


def test_a_damaged_episode_is_simulated_again(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    for damage in (b"", b"not hdf5", None):
        out = tmp_path / f"out {damage!r}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(writer.DemonstrationWriter, "assemble", lambda self: None)
            with pytest.raises(DataNotFoundError):
                record(fake_data, out)
        path = out / "episodes" / "000.hdf5"
        path.write_bytes(path.read_bytes()[:3000] if damage is None else damage)
        played.clear()
        record(fake_data, out)
        assert played == [5]
        assert contents(out) == whole


def test_a_damaged_data_set_is_an_error(fake_data: Path, tmp_path: Path, played: list[int]) -> None:
    record(fake_data, tmp_path / "out")
    path = main_file(tmp_path / "out")
    whole = path.read_bytes()
    for damaged in (b"", b"not hdf5", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(ResultsError, match=r"main_data\.hdf5 is damaged or no data set.*remove it and run again"):
            record(fake_data, tmp_path / "out")
        assert path.read_bytes() == damaged
    path.unlink()
    record(fake_data, tmp_path / "out")
    assert played == [5, 105, 5, 105]
    assert path.read_bytes() == whole


def test_the_command(fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demonstrate", "--receiver", "hold", "--physics", "fast", "--scenes", "5", "--data-dir", str(fake_data)]
    assert main(command) == 2
    assert "need an output folder; pass out= (--out DIR)" in capsys.readouterr().err
    command += ["--out", str(tmp_path / "out"), "--no-progress", "--workers", "1"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "1 episodes with 130 decisions of hold, giver replay, dexycb, s0 train, fast physics" in printed.out
    assert "Simulated: 1 (timeout 1)" in printed.out
    assert not printed.err
    assert main(["evaluate", str(tmp_path / "out")]) == 0
    assert "1 of 720 scenes (partial)" in capsys.readouterr().out
