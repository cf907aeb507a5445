"""Functions that record short episodes of a receiver with random actions at varying intervals."""

from pathlib import Path
from typing import Any

import numpy as np

import handover_marl
from handover_marl import Demonstrations
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.receivers import Receiver

#: Two scenes of the train split with right hands.
SCENES = (5, 105)
HORIZON = 600
SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=HORIZON))
#: Options of a recording with camera data, and with a giver that acts.
OPTIONS: dict[str, Any] = {"giver": "noisy", "obs_mode": "state+pointcloud", "robot": "panda_camera"}


class MovingReceiver(Receiver):
    """Receiver that moves its arm at random and holds each action for 50 to 150 ms."""

    name = "moving"

    def reset(self, seed: int | None = None) -> None:
        self.rng = np.random.default_rng(seed)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["robot_joint_position"] + 0.1 * self.rng.normal(size=9).astype(np.float32)

    @property
    def hold_time(self) -> float:
        return 0.001 * float(self.rng.integers(50, 150))


def record(out: Path | None, **options: Any) -> Demonstrations:
    """Record short episodes of synthetic scenes with `demonstrate`; `options` are its arguments and go first."""
    named: dict[str, Any] = {"receiver": MovingReceiver, "scenes": SCENES, "world_config": SHORT, "physics": "fast"}
    named |= {"dataset": "synthetic", "progress": False, "workers": 1}
    return handover_marl.demonstrate("s0", out=out, **{**named, **options})
