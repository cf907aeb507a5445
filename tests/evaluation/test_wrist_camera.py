"""Tests of evaluations of receivers that observe the wrist camera."""

import time
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.episode.episode import Episode
from handover_marl.errors import ResultsError
from handover_marl.evaluation.metadata import read_result_metadata
from tests.evaluation.quick import SHORT, QuickReceiver

OPTIONS: dict[str, Any] = {
    "dataset": "synthetic",
    "physics": "fast",
    "split": "val",
    "world_config": SHORT,
    "progress": False,
}


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
    run: dict[str, Any] = {"receiver": (Seeing, {"wait": 1.5}), "scenes": [9], "workers": 1, "out": tmp_path, **OPTIONS}
    report = handover_marl.evaluate_pair(**run, robot="panda_camera", camera_model="pinhole")
    assert report.episodes[0].plan_s < 0.2, "rendering time is not planning time"
    settings = read_result_metadata(tmp_path)
    assert (settings.robot, settings.wait_s) == ("panda_camera", "1.5")
    assert (settings.obs_mode, settings.camera) == ("state+pointcloud", "renderer rays, camera model pinhole")
    label = "(wait 1.5 s, obs_mode state+pointcloud, renderer rays, camera model pinhole, robot panda_camera)"
    assert label in str(report)
    bullet = {"robot": "panda_camera", "renderer": "bullet", "camera_model": "pinhole"}
    for other in ({}, {"robot": "panda_camera"}, bullet):
        with pytest.raises(ResultsError, match="holds another evaluation"):
            handover_marl.evaluate_pair(**run | other)
