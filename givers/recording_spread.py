"""Giver that deviates from its recording as much as recordings of the same object differ."""

import functools
import hashlib
import json
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory, to_numpy
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions
from handover_marl.policies.policy import PolicyContext

_SPREAD_FILE = files(__package__) / "recording_spread.json"
_ALL_OBJECTS = "all"
# Bounds of the playback rate minus 1.
_MIN_RATE, _MAX_RATE = -0.6, 1.0


@dataclass(frozen=True)
class RecordingSpreadConfig(CheckedConfig):
    """Configuration of `RecordingSpreadGiver`: factors of the standard deviations between recordings.

    Attributes:
        displacement: Factor of the displacement of the handover pose.
        rotation: Factor of the rotation of the handover pose.
        pace: Factor of the logarithm of the playback speed.
    """

    displacement: float = bounded(1.0, 0.0, 3.0)
    rotation: float = bounded(1.0, 0.0, 3.0)
    pace: float = bounded(1.0, 0.0, 3.0)


class RecordingSpreadGiver(ArrayGiver):
    """Giver that deviates from its recording as other recordings of the same object do.

    In every episode, displacement and rotation of the handover pose and the playback speed are drawn from normal
    distributions. Their standard deviations are those between the recordings of the object in DexYCB's s0 train
    split (`recording_spread.json`; for other objects those over all objects). The limits of the giver's motion apply:
    each component of the displacement is at most 0.3 m, that of the rotation vector at most 1 rad, and the motion is
    at most twice as fast as recorded.
    """

    name = "recording_spread"
    default_config = RecordingSpreadConfig()
    config: RecordingSpreadConfig

    def __init__(self, context: PolicyContext | None = None, **options: float) -> None:
        super().__init__(context, **options)
        self._object_names = CLASS_NAMES if context is None else context.object_names

    @property
    def weights_hash(self) -> str:
        """Hash of the table of standard deviations."""
        return hashlib.sha256(_SPREAD_FILE.read_bytes()).hexdigest()

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes: random deviations, in standard deviations."""
        self._draws = np.zeros((count, 7))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with random deviations."""
        self._draws[row] = np.random.default_rng(seed).standard_normal(7)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the deviations of these episodes."""
        config, draws, spread = self.config, self._draws[to_numpy(rows)], _read_spread()
        names = [self._object_names.get(int(number)) for number in to_numpy(observation["object_classes"][:, 0])]
        found = [spread.get(name or _ALL_OBJECTS, spread[_ALL_OBJECTS]) for name in names]
        pace, displacement, rotation = (
            np.array([row[key] for row in found]) for key in ("log_pace", "displacement", "rotation")
        )
        rate = np.clip(np.exp(config.pace * pace * draws[:, 6]) - 1.0, _MIN_RATE, _MAX_RATE)
        shifts = config.displacement * displacement * draws[:, :3]
        turns = config.rotation * rotation * draws[:, 3:6]
        return self.make_actions(rows, *map(self._arrays.asarray, (rate, shifts, turns)))


@functools.cache
def _read_spread() -> dict[str, dict[str, Any]]:
    """Return the standard deviations between recordings by class name of the object."""
    spread: dict[str, dict[str, Any]] = json.loads(_SPREAD_FILE.read_text())["objects"]
    return spread
