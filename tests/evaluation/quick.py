"""Evaluations that take little time: few scenes, short episodes and a receiver that does not move."""

from pathlib import Path
from typing import Any

import numpy as np

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.metadata import ResultMetadata
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.tables import FLUENCY
from handover_marl.evaluation.results import EpisodeResult, ResultFolder, encode_result
from handover_marl.receivers import Receiver

SCENES = (9, 14)
HORIZON = 400
#: Rules that end an episode after 0.4 s.
SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=HORIZON))


class QuickReceiver(Receiver):
    """Receiver that holds still and acts every 0.3 s."""

    name = "quick"
    control_period = 0.3

    def reset(self, seed: int | None = None) -> None:
        self.seed = seed

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["robot_joint_position"]


def run(data: Path | None, out: Path | None = None, **options: Any) -> Report:
    """Evaluate a receiver that holds still with the official giver in two scenes, unless `options` say otherwise."""
    named = {"giver": "replay", "receiver": QuickReceiver, "setup": "s0", "split": "val", "scenes": SCENES}
    named |= {"physics": "fast", "world_config": SHORT, "progress": False, "workers": 1}
    return handover_marl.evaluate_pair(data_dir=data, out=out, **{**named, **options})


def untimed(report: Report) -> list[tuple[Any, ...]]:
    return [(e.index, e.scene_id, e.status, e.steps, e.release_step, e.object_name) for e in report.episodes]


def make_report() -> Report:
    """Return a report of a success in scene 209 and a drop in scene 214, both with fluency metrics."""
    known: dict[str, Any] = {"n_objects": 1, "models": "MANO hands", "machine": "a machine", "fingerprint": "data"}
    episodes = []
    for index, (scene, status) in enumerate(((209, EpisodeStatus.SUCCESS), (214, EpisodeStatus.OBJECT_DROP))):
        metrics: dict[str, Any] = {column.key: 0.25 + index + number for number, column in enumerate(FLUENCY)}
        fluency = FluencyMetrics(**metrics | {"gripper_jerk": None})
        episodes.append(EpisodeResult(index, status, 4000 + index, 0.5 + index, scene, fluency=fluency, **known))
    metadata = ResultMetadata("s0", "test", "mine", "replay", "exact", "dexycb", "1.0")
    return Report(metadata, tuple(episodes))


def write_results(path: Path, report: Report | None = None) -> Path:
    """Write the result folder of a report, by default that of `make_report`, to a path, and return it."""
    report = report or make_report()
    folder = ResultFolder(path, report.metadata)
    for result in report.episodes:
        times = np.zeros(result.steps)
        times[0] = result.plan_s
        folder.write(result, encode_result(result, np.zeros((result.steps, 9), np.float32), times))
    return path
