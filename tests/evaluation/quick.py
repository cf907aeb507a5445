"""Evaluations that take little time: few scenes, short episodes and a receiver that does not move."""

from pathlib import Path
from typing import Any

import numpy as np

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.evaluation.reports.report import Report
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


def run(data: Path, out: Path | None = None, **options: Any) -> Report:
    """Evaluate a receiver that holds still with the official giver in two scenes, unless `options` say otherwise."""
    named = {"giver": "replay", "receiver": QuickReceiver, "setup": "s0", "split": "val", "scenes": SCENES}
    named |= {"physics": "fast", "world_config": SHORT, "progress": False, "workers": 1}
    return handover_marl.evaluate_pair(data_dir=data, out=out, **{**named, **options})


def untimed(report: Report) -> list[tuple[Any, ...]]:
    return [(e.index, e.scene_id, e.status, e.steps, e.release_step, e.object_name) for e in report.episodes]
