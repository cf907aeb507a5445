"""Giver that deviates from its recording as much as recordings of the same object differ."""

import functools
import hashlib
import json
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from handover_marl.config import CheckedConfig, Limits
from handover_marl.episode.observations import Observation
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action

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

    limits: ClassVar[Limits] = dict.fromkeys(("displacement", "rotation", "pace"), (0.0, 3.0))

    displacement: float = 1.0
    rotation: float = 1.0
    pace: float = 1.0


class RecordingSpreadGiver(Giver):
    """Giver that deviates from its recording as other recordings of the same object do.

    In every episode, displacement and rotation of the handover pose and the playback speed are drawn from normal
    distributions. Their standard deviations are those between the recordings of the object in DexYCB's s0 train
    split (`recording_spread.json`; for other objects those over all objects). The limits of the giver's motion apply:
    each component of the displacement is at most 0.3 m, that of the rotation vector at most 1 rad, and the motion is
    at most twice as fast as recorded.

    Args:
        context: Object classes; default: those of DexYCB.
        displacement: Factor of the standard deviation of the displacement, up to 3.
        rotation: Factor of the standard deviation of the rotation, up to 3.
        pace: Factor of the standard deviation of the logarithm of the playback speed, up to 3.
    """

    name = "recording_spread"

    def __init__(
        self,
        context: PolicyContext | None = None,
        displacement: float = RecordingSpreadConfig.displacement,
        rotation: float = RecordingSpreadConfig.rotation,
        pace: float = RecordingSpreadConfig.pace,
    ) -> None:
        super().__init__(context)
        self.config = RecordingSpreadConfig(displacement, rotation, pace)
        self._object_names = CLASS_NAMES if context is None else context.object_names

    @property
    def weights_hash(self) -> str:
        """Hash of the table of standard deviations."""
        return hashlib.sha256(_SPREAD_FILE.read_bytes()).hexdigest()

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with random deviations, in standard deviations."""
        self._draws = np.random.default_rng(seed).standard_normal(7)
        self._action: Action | None = None

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) with the deviation of this episode."""
        if self._action is None:
            self._action = self._choose_action(int(observation["object_classes"][0]))
        action: Action = self._action.copy()
        return action

    def _choose_action(self, object_class: int) -> Action:
        spread = _read_spread()
        row = spread.get(self._object_names.get(object_class, _ALL_OBJECTS), spread[_ALL_OBJECTS])
        config, draws = self.config, self._draws
        rate = float(np.exp(config.pace * row["log_pace"] * draws[6])) - 1.0
        return make_giver_action(
            float(np.clip(rate, _MIN_RATE, _MAX_RATE)),
            config.displacement * np.array(row["displacement"]) * draws[:3],
            config.rotation * np.array(row["rotation"]) * draws[3:6],
        )


@functools.cache
def _read_spread() -> dict[str, dict[str, Any]]:
    """Return the standard deviations between recordings by class name of the object."""
    spread: dict[str, dict[str, Any]] = json.loads(_SPREAD_FILE.read_text())["objects"]
    return spread
