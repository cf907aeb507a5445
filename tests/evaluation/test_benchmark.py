"""Tests of evaluations: official rules and files, resuming and errors."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.episode.episode import Episode
from handover_marl.errors import (
    DataNotFoundError,
    OptionError,
    PolicyError,
    ResultsError,
    SceneError,
    UnknownArgumentError,
)
from handover_marl.evaluation.episode_runner import EpisodeRunner
from handover_marl.evaluation.metadata import read_result_metadata
from handover_marl.evaluation.reports.report import load_report
from handover_marl.evaluation.results import find_recordings
from handover_marl.givers import Giver
from handover_marl.givers.variations import ReplayGiver
from handover_marl.receivers.baselines import HoldReceiver
from tests.evaluation.quick import HORIZON, SHORT, QuickReceiver, run, untimed

# Names of givers and receivers; the names of two pairs, joined by "-", are equal.
NAMES = ((ReplayGiver, ("replay", "replay-late")), (HoldReceiver, ("late-hold", "hold")))


@pytest.mark.slow
def test_options_are_checked_and_stated(fake_data: Path, tmp_path: Path) -> None:
    first, again = run(fake_data, tmp_path), run(fake_data, tmp_path)
    assert again.n_resumed == 2
    assert again.metadata == first.metadata
    assert untimed(again) == untimed(first)
    noisy = replace(SHORT, initial_joint_noise=0.1)
    assert run(fake_data, world_config=noisy).metadata.world.endswith(" initial_joint_noise=0.1")
    with pytest.raises(ResultsError, match=r"another evaluation .*world"):
        run(fake_data, tmp_path, world_config=noisy)
    own = [[type("Own", (base,), {"name": name}) for name in names] for base, names in NAMES]
    official: Any = handover_marl.benchmark
    for call, error, message in (
        (lambda: run(fake_data, tmp_path, shard="1/2", overwrite=True), OptionError, "left out with a shard, got both"),
        (lambda: official(color=[9]), UnknownArgumentError, "unexpected keyword argument 'color'$"),
        (lambda: official(scene=[9]), UnknownArgumentError, "argument 'scene'; did you mean 'scenes'\\?$"),
        (lambda: official(world_config=SHORT), OptionError, r"world_config must be left out of benchmark\(\).*_pair"),
        (lambda: official(data_dir=fake_data, giver="noisy"), OptionError, "giver must be left out of benchmark"),
        (lambda: handover_marl.crossplay(*own), OptionError, "folder of its own, got replay-late-hold twice"),
        (lambda: handover_marl.crossplay("replay", "hold", giver="noisy"), OptionError, "got noisy; name it in givers"),
    ):
        with pytest.raises(error, match=message):
            call()


@pytest.mark.slow
def test_results_are_official_files(fake_data: Path, tmp_path: Path) -> None:
    report = run(fake_data, tmp_path)
    assert [episode.scene_id for episode in report.episodes] == [9, 14]
    assert all(episode.status.label == "timeout" and episode.steps == HORIZON for episode in report.episodes)
    with np.load(tmp_path / "001.npz") as file:
        assert file["action"].shape == (HORIZON, 9)
        assert file["elapsed_time"].shape == (HORIZON,)
        assert np.count_nonzero(file["elapsed_time"]) == 2
        assert (file["elapsed_frame"], file["result"], file["scene_id"]) == (HORIZON, 8, 14)
        np.testing.assert_array_equal(file["action"][:300], file["action"][:1].repeat(300, axis=0))
    benchmark = yaml.safe_load((tmp_path / "config.yaml").read_text())["BENCHMARK"]
    assert (benchmark["SETUP"], benchmark["SPLIT"]) == ("s0", "val")
    assert json.loads((tmp_path / "report.json").read_text())["rates"]["timeout"]["rate"] == 1.0
    assert "| 14 " in (tmp_path / "report.md").read_text()
    reports = ("episodes.csv", "report.html", "report.json", "report.md")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000.npz", "001.npz", "config.yaml", *reports]


@pytest.mark.slow
def test_an_interrupted_evaluation_resumes(
    fake_data: Path, tmp_path: Path, played: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    play = EpisodeRunner.run

    def play_once(*args: Any) -> Any:
        if played:
            raise KeyboardInterrupt
        return play(*args)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeRunner, "run", play_once)
        with pytest.raises(KeyboardInterrupt):
            run(fake_data, tmp_path)
    assert played == [9]
    assert not (tmp_path / "report.json").exists()
    resumed = run(fake_data, tmp_path)
    assert played == [9, 14]
    assert untimed(resumed) == untimed(run(fake_data))
    assert resumed.n_resumed == 1
    assert "1 of the 2 episodes come from an earlier run." in str(resumed)
    assert json.loads((tmp_path / "report.json").read_text())["n_resumed"] == 1
    # A truncated result is simulated again, too.
    path = tmp_path / "001.npz"
    path.write_bytes(path.read_bytes()[:-50])
    (tmp_path / ".000.npz.xyz.part").write_bytes(b"left over")
    with pytest.raises(ResultsError, match=r"001\.npz.*run"):
        load_report(tmp_path)
    assert untimed(run(fake_data, tmp_path)) == untimed(resumed)


def test_folders_of_another_evaluation_are_unchanged(fake_data: Path, own_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(fake_data, out, scenes=[9])
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(
        ResultsError, match=r"another evaluation \(receiver 'quick' in the folder, 'hold' now; receiver hash "
    ):
        run(fake_data, out, receiver="hold", scenes=[9])
    meta = own_data / "dex-ycb-cache" / "meta_009.json"
    meta.write_text(meta.read_text() + " ")
    with pytest.raises(ResultsError, match=r"000\.npz was computed from data that differ"):
        run(own_data, out, scenes=[9])
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="is a file; out must be a folder"):
        run(fake_data, tmp_path / "file")
    assert before == {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.mark.slow
def test_a_full_disk_loses_nothing(fake_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, calls = os.fsync, []

    def full_after_two(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 2:
            raise OSError(28, "No space left on device")
        write(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full_after_two)
        with pytest.raises(ResultsError, match=r"001\.npz.*No space left.*same command"):
            run(fake_data, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000.npz", "config.yaml"]
    assert len(run(fake_data, tmp_path).episodes) == 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"scenes": [9, 10]}, SceneError, "scene 10 is not in s0 val"),
        ({"scenes": []}, SceneError, "scenes must not be empty"),
        ({"scenes": [19]}, DataNotFoundError, "meta_019"),
    ],
)
def test_errors_leave_no_output(
    fake_data: Path, tmp_path: Path, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        run(fake_data, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


class Failing(QuickReceiver):
    name = "failing"

    def __init__(self, context: Any, at_once: bool = False) -> None:
        super().__init__(context)
        if at_once:
            raise KeyError("nonsense")

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        raise KeyError("nonsense")


class FailingGiver(Giver):
    name = "failing"

    def reset(self, seed: int | None = None) -> None:
        """Do nothing; the giver has no state."""

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        raise LookupError("nonsense")


@pytest.mark.slow
def test_errors_of_policies_are_reported_with_their_names(fake_data: Path, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"(?s)receiver 'failing' in scene (9|14): .*KeyError.*nonsense"):
        run(fake_data, tmp_path / "out", receiver=Failing, workers=2)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["config.yaml"]
    with pytest.raises(PolicyError, match=r"(?s)giver 'failing' in scene 9: .*'failing'.*LookupError.*nonsense"):
        run(fake_data, giver=FailingGiver)
    with pytest.raises(PolicyError, match=r"receiver 'Failing' cannot be made .*KeyError.*nonsense"):
        run(fake_data, tmp_path / "none", receiver=(Failing, {"at_once": True}))
    assert not (tmp_path / "none").exists()


def official_folder(folder: Path, n: int = 144, **changes: Any) -> Path:
    """Write a result folder as HandoverSim does, and return it."""
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


@pytest.mark.slow
def test_folders_of_the_original_code(tmp_path: Path) -> None:
    report = load_report(official_folder(tmp_path / "2022-02-28_12-40-26_omg-planner_s0_test"))
    assert report.metadata.receiver == "omg-planner"
    assert not report.is_partial
    assert report.success_rate == 0.25
    assert report.official_means["exec_s"].mean == pytest.approx((5000 + 5140) / 2 / 1000)
    assert report.episodes[0].scene_id == 209
    assert report.episodes[0].object_name == "003_cracker_box"
    assert "published: OMG Planner" in str(report)


class Seeing(QuickReceiver):
    """Receiver that observes point clouds and holds still."""

    name = "seeing"
    obs_mode = "state+pointcloud"

    def __init__(self, context: Any, wait: float = 0.0) -> None:
        super().__init__(context)
        self._wait = wait

    @property
    def wait(self) -> float:
        return self._wait


@pytest.mark.slow
def test_results_store_robot_observation_mode_and_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw = Episode.observe_camera

    def slowly(self: Episode, obs_mode: str) -> Any:
        time.sleep(0.2)
        return draw(self, obs_mode)

    monkeypatch.setattr(Episode, "observe_camera", slowly)
    options: dict[str, Any] = {"dataset": "synthetic", "receiver": (Seeing, {"wait": 1.5}), "scenes": [9]}
    report = run(None, tmp_path, **options, robot="panda_camera", camera_model="pinhole")
    assert report.episodes[0].plan_s < 0.2, "rendering time is not planning time"
    settings = read_result_metadata(tmp_path)
    assert (settings.robot, settings.wait_s) == ("panda_camera", "1.5")
    assert (settings.obs_mode, settings.camera) == ("state+pointcloud", "renderer rays, camera model pinhole")
    label = "(wait 1.5 s, obs_mode state+pointcloud, renderer rays, camera model pinhole, robot panda_camera)"
    assert label in str(report)
    bullet = {"robot": "panda_camera", "renderer": "bullet", "camera_model": "pinhole"}
    for other in ({}, {"robot": "panda_camera"}, bullet):
        with pytest.raises(ResultsError, match="holds another evaluation"):
            run(None, tmp_path, **options, **other)


@pytest.mark.slow
def test_time_series_of_an_episode(tmp_path: Path) -> None:
    """A finished episode is simulated again; the columns agree with each other and with the metrics."""
    rules = WorldConfig(protocol=ProtocolConfig(horizon_steps=1000))
    options = {"dataset": "synthetic", "scenes": [9], "receiver": "yang2021:wait=0", "world_config": rules}
    run(None, tmp_path, **options)
    (fluency,) = [episode.fluency for episode in run(None, tmp_path, traces=True, **options).episodes]
    assert fluency is not None
    path = tmp_path / "traces" / "009.csv"
    assert find_recordings(tmp_path) == [path]
    rows = np.genfromtxt(path, delimiter=",", names=True)
    np.testing.assert_allclose(rows["time"], np.arange(51) * 0.02)
    gripper, wrist = (np.stack([rows[f"{point}_{axis}"] for axis in "xyz"], axis=1) for point in ("gripper", "wrist"))
    assert np.isfinite(wrist[-1]).all()
    np.testing.assert_allclose(rows["gripper_wrist_distance"], np.linalg.norm(gripper - wrist, axis=1), atol=1e-5)
    assert rows["gripper_speed"].max() == pytest.approx(fluency.gripper_max_speed, rel=1e-4) != 0.0
    assert rows["robot_object_force"].max() == pytest.approx(fluency.max_robot_object_force, rel=1e-4)
    with pytest.raises(OptionError, match="traces need an output folder"):
        run(None, traces=True, **options)
