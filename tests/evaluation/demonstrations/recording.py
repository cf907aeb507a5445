"""Functions that record short episodes of a receiver with random actions at varying intervals."""

from pathlib import Path
from typing import Any

import numpy as np

import handover_marl
from handover_marl import Demonstrations
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.evaluation.demonstrations.demonstration import Demonstration
from handover_marl.receivers import Receiver

#: Two scenes with right hands, in the train split of both the synthetic and the small official data set.
SCENES = (5, 105)
HORIZON = 600
SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=HORIZON))


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


def record(data: Path | None, out: Path | None, **options: Any) -> Demonstrations:
    """Record short episodes of scenes in the folder `data`, or of synthetic scenes if it is None."""
    named: dict[str, Any] = {"receiver": MovingReceiver, "scenes": SCENES, "world_config": SHORT, "physics": "fast"}
    named |= {"data_dir": data, "dataset": "synthetic" if data is None else "dexycb", "progress": False, "workers": 1}
    return handover_marl.demonstrate("s0", out=out, **{**named, **options})


def contents(out: Path) -> dict[str, bytes]:
    """Return the content of every file of the demonstrations, by its name."""
    return {path.name: path.read_bytes() for path in sorted((out / "demonstrations").iterdir())}


def assert_same(one: Demonstration, other: Demonstration) -> None:
    """Check that two demonstrations are equal, including every value of their arrays."""
    assert one.metadata == other.metadata
    assert list(one.observations) == list(other.observations)
    for name, array in one.observations.items():
        np.testing.assert_array_equal(other.observations[name], array, err_msg=name, strict=True)
    for name in ("actions", "rewards", "terminations", "truncations", "steps", "giver_steps", "giver_actions"):
        np.testing.assert_array_equal(getattr(other, name), getattr(one, name), err_msg=name, strict=True)
