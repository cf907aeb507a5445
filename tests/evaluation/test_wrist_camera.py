"""Tests of evaluations of receivers that observe the wrist camera."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.episode.episode import Episode
from handover_marl.errors import ResultsError
from handover_marl.evaluation.metadata import read_result_metadata
from handover_marl.receivers import Receiver
from tests.evaluation.quick import SHORT

OPTIONS: dict[str, Any] = {
    "dataset": "synthetic",
    "physics": "fast",
    "split": "val",
    "world_config": SHORT,
    "progress": False,
}
SCENES = (9, 14)
#: Rules for episodes that are long enough for the hand to come into view.
LONGER = WorldConfig(protocol=ProtocolConfig(horizon_steps=1300))


class Seeing(Receiver):
    """Receiver whose actions, and so the result files, depend on all point clouds that it observes."""

    name = "seeing"
    control_period = 0.3
    obs_mode = "state+pointcloud"

    def __init__(self, context: Any, wait: float = 0.0) -> None:
        super().__init__(context)
        self._wait = wait

    @property
    def wait(self) -> float:
        return self._wait

    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        marks = [observation[f"wrist_{name}_points"].astype(np.float64).sum() for name in ("object", "hand")]
        action = observation["robot_joint_position"].copy()
        action[:3] += 1e-3 * np.array([*marks, observation["wrist_point_counts"].sum() / 1000.0], dtype=np.float32)
        return action


def actions(folder: Path) -> list[np.ndarray]:
    return [np.load(path)["action"] for path in sorted(folder.glob("[0-9]*.npz"))]


@pytest.mark.slow
def test_point_clouds_do_not_depend_on_the_worker(tmp_path: Path) -> None:
    options = {**OPTIONS, "world_config": LONGER}
    for workers in (1, 2):
        out = tmp_path / str(workers)
        handover_marl.evaluate_pair(receiver=Seeing, scenes=SCENES, workers=workers, out=out, **options)
    first, second = actions(tmp_path / "1"), actions(tmp_path / "2")
    assert len(first) == len(SCENES)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    assert any(len(np.unique(one[:, 0])) > 2 for one in first), "something was seen"


def test_rendering_time_is_not_planning_time(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = Episode.observe_camera

    def slowly(self: Episode, obs_mode: str) -> Any:
        time.sleep(0.2)
        return draw(self, obs_mode)

    monkeypatch.setattr(Episode, "observe_camera", slowly)
    report = handover_marl.evaluate_pair(receiver=Seeing, scenes=SCENES[:1], workers=1, **OPTIONS)
    assert report.episodes[0].plan_s < 0.2


def test_results_store_robot_observation_mode_and_wait(tmp_path: Path) -> None:
    run = {"receiver": (Seeing, {"wait": 1.5}), "scenes": SCENES[:1], "workers": 1, "out": tmp_path, **OPTIONS}
    report = handover_marl.evaluate_pair(**run, robot="panda_camera", camera_model="pinhole")
    settings = read_result_metadata(tmp_path)
    assert (settings.robot, settings.wait_s) == ("panda_camera", "1.5")
    assert (settings.obs_mode, settings.camera) == ("state+pointcloud", "renderer rays, camera model pinhole")
    assert "(wait 1.5 s, obs_mode state+pointcloud, renderer rays, camera model pinhole, robot panda_camera)" in str(
        report
    )
    for other in (
        {},
        {"robot": "panda_camera"},
        {"robot": "panda_camera", "renderer": "bullet", "camera_model": "pinhole"},
    ):
        with pytest.raises(ResultsError, match="holds another evaluation"):
            handover_marl.evaluate_pair(**run, **other)
