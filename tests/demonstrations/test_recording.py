"""The folder: going on, workers, what is kept, what is refused."""

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
from handover_marl.benchmarking import playing
from handover_marl.cli import main
from handover_marl.config import OFFICIAL
from handover_marl.demonstrations import data_set_files, demonstration_shelf, hdf5
from handover_marl.errors import DataNotFoundError, OptionError, ResultsError, UnknownNameError
from tests.demonstrations.recording import SCENES, SHORT, MovingReceiver, assert_same, contents, main_file, record

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def whole(fake_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What an undisturbed recording makes."""
    record(fake_data, out := tmp_path_factory.mktemp("whole") / "out")
    return contents(out)


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The scenes that this process plays from now on."""
    scenes: list[int] = []
    play = playing.Player.play

    def noted(player: Any, task: Any) -> Any:
        scenes.append(task.scene_id)
        return play(player, task)

    monkeypatch.setattr(playing.Player, "play", noted)
    return scenes


def test_data_do_not_depend_on_workers(tmp_path: Path) -> None:
    options: dict[str, Any] = {"giver": "noisy", "sight": "points"}
    for workers in (1, 2):
        record(None, tmp_path / str(workers), workers=workers, **options)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert sorted(contents(tmp_path / "1")) == ["main_data.hdf5", "metadata.json"]
    assert not (tmp_path / "1" / "episodes").exists()


KILLED = """
import sys, time
from pathlib import Path
from handover_marl.benchmarking.playing import Player
from tests.demonstrations.recording import record

play = Player.play

def slowly(player, task):
    if task.scene_id != 5:
        time.sleep(100.0)
    return play(player, task)

Player.play = slowly
record(Path(sys.argv[1]), Path(sys.argv[2]))
"""


def test_a_killed_run_goes_on(fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]) -> None:
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
    # What a writer leaves that is killed in the middle.
    (out / "data" / ".main_data.hdf5.abcd1234.part").write_bytes(b"half")
    record(fake_data, out)
    assert played == [105]
    assert contents(out) == whole


def test_a_run_that_is_stopped_while_it_puts_episodes_together_goes_on(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    for module, name in ((data_set_files, "_copy"), (demonstration_shelf, "metadata_text")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, name, stopped)
            with pytest.raises(KeyboardInterrupt):
                record(fake_data, tmp_path / "out")
        assert not list((tmp_path / "out" / "data").glob(".*"))
    record(fake_data, tmp_path / "out")
    assert played == list(SCENES)
    assert contents(tmp_path / "out") == whole


def test_more_scenes_come_to_the_others_in_the_order_of_the_split(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    record(fake_data, tmp_path / "out", scenes=[105])
    record(fake_data, tmp_path / "out", scenes=[5])
    again = record(fake_data, tmp_path / "out", scenes=[5, 105])
    assert played == [105, 5]
    assert [facts.scene_id for facts in again.facts()] == [5, 105]
    assert contents(tmp_path / "out") == whole


def test_recording_changes_nothing_about_the_run(tmp_path: Path) -> None:
    record(None, tmp_path / "recorded", sight="points", giver="noisy")
    run: dict[str, Any] = {"receiver": MovingReceiver, "split": "train", "scenes": SCENES, "config": SHORT}
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
        "import pathlib, sys; from handover_marl.files import alone_in\n"
        "with alone_in(pathlib.Path(sys.argv[1])): print('in', flush=True); sys.stdin.read()"
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
    """`hold` never succeeds; one scene with a success is enough for the others."""
    options: dict[str, Any] = {"receiver": "yang2021:wait=0", "config": OFFICIAL, "scenes": [5, 10]}
    some = record(None, tmp_path / "out", keep="success", **options)
    outcomes = [facts.outcome for facts in some.facts()]
    assert (played, outcomes) == ([5, 10], ["success"])
    assert "Played: 2 (" in str(some)
    again = record(None, tmp_path / "out", keep="success", **options)
    assert len(played) == 2, "what is not kept is not played again"
    assert_same(some[0], again[0])
    every = record(None, tmp_path / "out", **options)
    assert played == [5, 10, 10]
    assert sorted(facts.success for facts in every.facts()) == [False, True]
    assert len(record(None, tmp_path / "out", keep="success", **options)) == 1


def test_nothing_worth_keeping(fake_data: Path, tmp_path: Path) -> None:
    for _ in range(2):
        nothing = record(fake_data, tmp_path / "out", keep="success", scenes=[5])
        assert (len(nothing), nothing.facts(), list(nothing)) == (0, [], [])
        assert nothing.decisions(["time"])[1].shape == (0, 9)
    assert "0 episodes with 0 decisions" in str(nothing)
    assert "Played: 1 (timeout 1)" in str(nothing)


@pytest.mark.parametrize(("split", "why"), [("val", "to choose with"), ("test", "for the last look")])
def test_other_splits_are_refused(
    fake_data: Path, tmp_path: Path, split: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(OptionError, match=f"s0 {split} is {why}.*Take split 'train'"):
        record(fake_data, tmp_path / "out", split=split)
    with pytest.raises(OptionError, match=why):
        handover_marl.demonstrate(handover_marl.Run(split=split), out=tmp_path / "out")
    assert main(["demonstrate", "--split", split, "--out", str(tmp_path / "out"), "--data-dir", str(fake_data)]) == 2
    assert why in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_recorded_is_told_before_anything_is_played(
    fake_data: Path, tmp_path: Path, played: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, match, options in (
        (OptionError, "need a folder", {"out": None}),
        (UnknownNameError, "unknown keep 'some'; valid: all, success", {"keep": "some"}),
        (UnknownNameError, "unknown sight 'sonar'", {"sight": "sonar"}),
        (OptionError, "sight is None", {"observe": "sight"}),
        (UnknownNameError, "unknown split", {"split": "later"}),
        (UnknownNameError, "unknown renderer", {"renderer": "x", "sight": "points"}),
    ):
        with pytest.raises(error, match=match):
            record(fake_data, **{"out": tmp_path / "out", **options})
    monkeypatch.setattr(hdf5.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"need h5py: pip install 'handover-marl\[demonstrations\]'"):
        record(fake_data, tmp_path / "out")
    assert not played
    assert not (tmp_path / "out").exists()


def test_other_folders_are_left_alone(fake_data: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("precious")
    with pytest.raises(ResultsError, match="is no result folder"):
        record(fake_data, foreign)
    assert [path.name for path in foreign.iterdir()] == ["thesis.txt"]
    record(fake_data, tmp_path / "out", scenes=[5])
    before = contents(tmp_path / "out")
    for other in ({"sight": "points"}, {"seed": 1}, {"giver": "noisy"}, {"physics": "exact"}):
        with pytest.raises(ResultsError, match="holds another run"):
            record(fake_data, tmp_path / "out", scenes=[5], **other)
    run: dict[str, Any] = {"receiver": MovingReceiver, "split": "train", "scenes": [5], "config": SHORT}
    run |= {"data_dir": fake_data, "physics": "fast", "progress": False, "workers": 1}
    with pytest.raises(ResultsError, match="kept 'demonstrations, without sight' there, '' now"):
        handover_marl.evaluate_pair("replay", out=tmp_path / "out", **run)
    assert contents(tmp_path / "out") == before
    handover_marl.evaluate_pair("replay", out=tmp_path / "plain", **run)
    with pytest.raises(ResultsError, match="kept '' there"):
        record(fake_data, tmp_path / "plain", scenes=[5])


def test_starting_anew_leaves_nothing_of_what_was_there(fake_data: Path, tmp_path: Path, played: list[int]) -> None:
    record(fake_data, tmp_path / "out")
    (tmp_path / "out" / "data" / "notes.txt").write_text("precious")
    anew = record(fake_data, tmp_path / "out", seed=1, scenes=[5], fresh=True)
    assert played == [5, 105, 5]
    assert [(facts.scene_id, facts.seed) for facts in anew.facts()] == [(5, 1)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demonstration_shelf.DemonstrationShelf, "assemble", lambda self: None)
        with pytest.raises(DataNotFoundError, match="not finished"):
            record(fake_data, tmp_path / "out", scenes=[5], fresh=True)
    assert (tmp_path / "out" / "data" / "notes.txt").read_text() == "precious"


def test_a_damaged_episode_is_played_again(
    fake_data: Path, tmp_path: Path, whole: dict[str, bytes], played: list[int]
) -> None:
    for damage in (b"", b"not hdf5", None):
        out = tmp_path / f"out {damage!r}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(demonstration_shelf.DemonstrationShelf, "assemble", lambda self: None)
            with pytest.raises(DataNotFoundError):
                record(fake_data, out)
        path = out / "episodes" / "000.hdf5"
        path.write_bytes(path.read_bytes()[:3000] if damage is None else damage)
        played.clear()
        record(fake_data, out)
        assert played == [5]
        assert contents(out) == whole


def test_a_damaged_data_set_is_not_built_upon(fake_data: Path, tmp_path: Path, played: list[int]) -> None:
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
    assert "need a folder: give one as out= (--out DIR)" in capsys.readouterr().err
    command += ["--out", str(tmp_path / "out"), "--no-progress", "--workers", "1"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "1 episodes with 130 decisions of hold, giver replay, dexycb, s0 train, fast physics" in printed.out
    assert "Played: 1 (timeout 1)" in printed.out
    assert not printed.err
    assert main(["evaluate", str(tmp_path / "out")]) == 0
    assert "1 of 720 scenes (partial)" in capsys.readouterr().out
