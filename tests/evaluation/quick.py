"""Runs that cost next to nothing: few scenes, short episodes, a receiver that does nothing."""

from pathlib import Path
from typing import Any

import numpy as np

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.evaluation.reports.report import Report
from handover_marl.receivers import Receiver

SCENES = (9, 14)
HORIZON = 1300
#: Rules that end an episode after a tenth of the time.
SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=HORIZON))


class QuickReceiver(Receiver):
    """Holds still; asked every second."""

    name = "quick"
    control_period = 1.0

    def reset(self, seed: int | None = None) -> None:
        self.seed = seed

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["robot_joint_position"]


def run(data: Path, out: Path | None = None, **options: Any) -> Report:
    """A receiver that costs nothing, with the official giver, in few scenes."""
    named = {"giver": "replay", "receiver": QuickReceiver, "setup": "s0", "split": "val", "scenes": SCENES}
    named |= {"physics": "fast", "world_config": SHORT, "progress": False, "workers": 1}
    return handover_marl.evaluate_pair(data_dir=data, out=out, **{**named, **options})


def untimed(report: Report) -> list[tuple[Any, ...]]:
    return [(e.index, e.scene_id, e.status, e.steps, e.release_step, e.object_name) for e in report.episodes]
