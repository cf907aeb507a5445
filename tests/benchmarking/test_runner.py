import functools
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import handover_marl
from handover_marl import receivers
from handover_marl.benchmarking import playing
from handover_marl.benchmarking.evaluation import evaluate
from handover_marl.benchmarking.report import Report
from handover_marl.config import ProtocolConfig
from handover_marl.errors import (
    ActionError,
    DataNotFoundError,
    OptionError,
    ResultsError,
    SceneError,
    UnknownNameError,
)
from handover_marl.givers.noisy import NoisyGiver
from handover_marl.receivers import Receiver

SCENES = (9, 14)
HORIZON = 1300


class QuickReceiver(Receiver):
    """Holds still; asked every second."""

    name = "quick"
    control_period = 1.0

    def reset(self, seed: int | None = None) -> None:
        self.seed = seed

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["robot_joint_position"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A receiver that costs nothing, rules that end an episode after a tenth of the time, and few scenes."""
    make = receivers.make

    def make_also_quick(name: str, dataset: Any, trust: bool = False) -> Receiver:
        if name == "quick":
            return QuickReceiver(receivers.context_of(dataset))
        return make(name, dataset, trust)

    monkeypatch.setattr(receivers, "make", make_also_quick)
    short = functools.partial(ProtocolConfig, horizon_steps=HORIZON)
    monkeypatch.setattr("handover_marl.episode.episode.ProtocolConfig", short)
    monkeypatch.setattr("handover_marl.benchmarking.playing.ProtocolConfig", short)


def run(data: Path, out: Path | None = None, **options: Any) -> Report:
    named = {"setup": "s0", "split": "val", "receiver": "quick", "scenes": SCENES, "progress": False, "workers": 1}
    return handover_marl.benchmark(data_dir=data, out=out, **{**named, **options})


def untimed(report: Report) -> list[tuple[Any, ...]]:
    return [(e.index, e.scene_id, e.status, e.steps, e.release_step, e.object_name) for e in report.episodes]


def test_results_are_official_files(fake_data: Path, tmp_path: Path) -> None:
    report = run(fake_data, tmp_path / "out")
    assert [episode.scene_id for episode in report.episodes] == [9, 14]
    assert all(episode.status.label == "timeout" and episode.steps == HORIZON for episode in report.episodes)
    with np.load(tmp_path / "out" / "001.npz") as file:
        assert file["action"].shape == (HORIZON, 9)
        assert file["elapsed_time"].shape == (HORIZON,)
        assert np.count_nonzero(file["elapsed_time"]) == 2
        assert (file["elapsed_frame"], file["result"], file["scene_id"]) == (HORIZON, 8, 14)
        np.testing.assert_array_equal(file["action"][:1000], file["action"][:1].repeat(1000, axis=0))
    config = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert config["BENCHMARK"]["SETUP"] == "s0"
    assert config["BENCHMARK"]["SPLIT"] == "val"
    assert json.loads((tmp_path / "out" / "report.json").read_text())["rates"]["timeout"]["rate"] == 1.0
    assert "| 14 " in (tmp_path / "out" / "report.md").read_text()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("000.npz", "001.npz", "config.yaml", "report.json", "report.md"),
    ]


def test_evaluation_recomputes_the_same_report(fake_data: Path, tmp_path: Path) -> None:
    report = run(fake_data, tmp_path)
    again = evaluate(tmp_path)
    assert str(again) == str(report)
    assert again.to_json() == report.to_json()


@pytest.mark.parametrize("scenes", [np.array([14, 9]), (n for n in (9, 14, 9)), [np.int64(9), 14]])
def test_any_numbers_are_scenes(fake_data: Path, tmp_path: Path, scenes: Any) -> None:
    report = run(fake_data, tmp_path, scenes=scenes)
    assert [episode.scene_id for episode in report.episodes] == [9, 14]
    assert (tmp_path / "report.json").exists()


def test_an_interrupted_run_goes_on(fake_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played = []
    play = playing.play

    def play_once(*job: Any) -> Any:
        if played:
            raise KeyboardInterrupt
        played.append(job[1].info.scene_id)
        return play(*job)

    monkeypatch.setattr(playing, "play", play_once)
    with pytest.raises(KeyboardInterrupt):
        run(fake_data, tmp_path)
    assert played == [9]
    assert not (tmp_path / "report.json").exists()
    monkeypatch.setattr(playing, "play", lambda *a: (played.append(a[1].info.scene_id), play(*a))[1])
    resumed = run(fake_data, tmp_path)
    assert played == [9, 14]
    assert untimed(resumed) == untimed(run(fake_data))


@pytest.mark.parametrize("damage", [b"", b"PK", None])
def test_half_written_files_are_no_results(fake_data: Path, tmp_path: Path, damage: bytes | None) -> None:
    report = run(fake_data, tmp_path)
    path = tmp_path / "001.npz"
    path.write_bytes(path.read_bytes()[:-50] if damage is None else damage)
    (tmp_path / ".000.npz.xyz.part").write_bytes(b"left over")
    with pytest.raises(ResultsError, match=r"001\.npz.*run"):
        evaluate(tmp_path)
    assert untimed(run(fake_data, tmp_path)) == untimed(report)
    evaluate(tmp_path)


def test_folders_of_another_run_are_left_alone(fake_data: Path, own_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(fake_data, out, scenes=[9])
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(ResultsError, match=r"another run \(receiver 'quick' there, 'hold' now\)"):
        run(fake_data, out, receiver="hold")
    meta = own_data / "dex-ycb-cache" / "meta_009.json"
    meta.write_text(meta.read_text() + " ")
    with pytest.raises(ResultsError, match=r"000\.npz.*other data"):
        run(own_data, out, scenes=[9])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("precious")
    with pytest.raises(ResultsError, match="no result folder"):
        run(fake_data, tmp_path / "full")
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot use"):
        run(fake_data, tmp_path / "file")
    assert before == {path.name: path.read_bytes() for path in out.iterdir()}


def test_a_full_disk_loses_nothing(fake_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.fsync
    calls = []

    def full_after_two(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 2:
            raise OSError(28, "No space left on device")
        write(handle)

    monkeypatch.setattr(os, "fsync", full_after_two)
    with pytest.raises(ResultsError, match=r"001\.npz.*No space left.*same command"):
        run(fake_data, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000.npz", "config.yaml"]
    monkeypatch.setattr(os, "fsync", write)
    assert len(run(fake_data, tmp_path).episodes) == 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"setup": "s5"}, UnknownNameError, "setup 's5'; valid: s0, s1, s2, s3"),
        ({"split": "dev"}, UnknownNameError, "split 'dev'"),
        ({"receiver": "nobody"}, UnknownNameError, "receiver 'nobody'; valid: hold, learned, omg"),
        ({"scenes": [9, 10]}, SceneError, "scene 10 is not in s0 val"),
        ({"scenes": []}, SceneError, "no scene"),
        ({"scenes": 9}, SceneError, "expected scene numbers"),
        ({"scenes": "9"}, SceneError, "expected scene numbers"),
        ({"scenes": None}, DataNotFoundError, "meta_019"),
        ({"scenes": [19]}, DataNotFoundError, "meta_019"),
    ],
)
def test_errors_leave_no_output(
    fake_data: Path, tmp_path: Path, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        run(fake_data, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_receivers_that_misbehave(fake_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(QuickReceiver, "act", lambda self, seen: np.full(9, np.nan))
    with pytest.raises(ActionError, match=r"'quick' in scene 9: .*not finite"):
        run(fake_data, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["config.yaml"]
    monkeypatch.setattr(QuickReceiver, "act", lambda self, seen: seen["robot_joint_position"])
    monkeypatch.setattr(QuickReceiver, "hold_time", 0.0)
    with pytest.raises(OptionError, match="hold_time"):
        run(fake_data)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.full(8, np.nan), "giver's action is not finite"),
        (np.zeros(9), r"giver's action has shape \(9,\)"),
        ("wave", "giver's action is not numeric"),
        (None, "giver is missing"),
    ],
)
def test_givers_that_misbehave(fake_data: Path, monkeypatch: pytest.MonkeyPatch, action: object, message: str) -> None:
    monkeypatch.setattr(NoisyGiver, "act", lambda self, seen: action)
    with pytest.raises(ActionError, match=f"'quick' and giver 'noisy' in scene 9: .*{message}"):
        handover_marl.evaluate_pair(
            "noisy", "quick", split="val", scenes=SCENES, data_dir=fake_data, progress=False, workers=1
        )


def official_folder(folder: Path, n: int = 144, **changes: Any) -> Path:
    """A folder as the original code writes it."""
    folder.mkdir()
    config = {"BENCHMARK": {"SETUP": "s0", "SPLIT": "test"}, "SIM": {"TIME_STEP": 0.001}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    for index in range(n):
        content = {
            "action": np.zeros((5000 + index, 9)),
            "elapsed_time": np.full(5000 + index, 1e-5),
            "elapsed_frame": 5000 + index,
            "result": (1, 2, 4, 8)[index % 4],
        }
        np.savez_compressed(folder / f"{index:03d}.npz", **{**content, **changes})
    return folder


def test_folders_of_the_original_code(tmp_path: Path) -> None:
    report = evaluate(official_folder(tmp_path / "2022-02-28_12-40-26_omg-planner_s0_test"))
    assert report.settings.receiver == "omg-planner"
    assert not report.partial
    assert report.success_rate == 0.25
    assert report.time_exec == pytest.approx((5000 + 5140) / 2 / 1000)
    assert report.episodes[0].scene_id == 209
    assert report.episodes[0].object_name == "003_cracker_box"
    assert "published: OMG Planner" in str(report)


@pytest.mark.parametrize(
    "changes", [{"result": 0}, {"result": 3}, {"result": 16}, {"elapsed_frame": 0}, {"result": np.array([1, 2])}]
)
def test_impossible_results(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(ResultsError, match=r"000\.npz"):
        evaluate(official_folder(tmp_path / "run", 3, **changes))


def test_folders_that_are_none(tmp_path: Path) -> None:
    for make, message in (
        (lambda path: None, "does not exist"),
        (lambda path: path.mkdir(), "has no config.yaml"),
        (lambda path: (path / "config.yaml").write_text("BENCHMARK: 3"), "not a readable configuration"),
        (lambda path: (path / "config.yaml").write_text("!!python/object/apply:os.system [ls]"), "not a readable"),
        (lambda path: (path / "config.yaml").write_text("BENCHMARK: {SETUP: s9, SPLIT: test}"), "unknown setup"),
        (lambda path: (path / "config.yaml").write_text("BENCHMARK: {SETUP: s0, SPLIT: val}"), "no result files"),
        (lambda path: (path / "036.npz").write_bytes(b""), "036"),
    ):
        make(tmp_path / "run")
        with pytest.raises(ResultsError, match=message):
            evaluate(tmp_path / "run")
