"""Recorded episode: arrays of observations and actions, and its metadata."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl import __version__
from handover_marl.episode.observations import Observation
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference
from handover_marl.evaluation.results.episode_result import EpisodeResult

_UNKNOWN = -1
_NUMBERS = ("scene_id", "release_step")  # that may be unknown


@dataclass(frozen=True)
class EpisodeMetadata:
    """Scene, policies and outcome of a recorded episode.

    Attributes:
        scene_id: Scene number.
        object_name: YCB class of the object handed over, e.g. "025_mug".
        subject: Person recorded in the scene.
        side: Hand that gives the object, "right" or "left".
        outcome: "success", or "contact", "drop", "timeout", joined by "+" if they coincide.
        status: Outcome of the episode as bits of `handover_marl.EpisodeStatus`.
        steps: Physics steps (1 ms) until the end of the episode.
        release_step: Physics step whose contacts made the giver release the object; -1 without release.
        receiver: Label of the robot's policy.
        giver: Label of the person's policy.
        physics: Kind of physics.
        dataset: Dataset of the scene.
        robot: Robot model, with or without the wrist camera.
        seed: Seed of policies, camera and initial joint positions.
        models: Description of the hand model and of other substitutes for HandoverSim's models; empty
            without substitutes.
        fingerprint: Hash of the scene's data files.
        version: Version of this library.
    """

    scene_id: int
    object_name: str
    subject: str
    side: str
    outcome: str
    status: int
    steps: int
    release_step: int
    receiver: str
    giver: str
    physics: str
    dataset: str
    robot: str
    seed: int
    models: str
    fingerprint: str
    version: str

    @classmethod
    def from_result(cls, result: EpisodeResult, config: EvaluationConfig) -> "EpisodeMetadata":
        """Create the metadata of an episode from its result and configuration.

        Args:
            result: Outcome of the episode.
            config: Resolved configuration of its evaluation.
        """
        policies = {agent: require_policy_reference(getattr(config, agent)).label for agent in ("receiver", "giver")}
        values: dict[str, Any] = {**vars(config), **vars(result), **policies, "version": __version__}
        values |= {"outcome": result.status.label, "status": int(result.status)}
        unknown = {name: _UNKNOWN if name in _NUMBERS else "" for name, value in values.items() if value is None}
        return cls(**{field.name: (values | unknown)[field.name] for field in fields(cls)})

    @property
    def success(self) -> bool:
        """Whether the handover was completed."""
        return self.outcome == "success"


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Recorded episode with T decisions of the receiver and G decisions of the giver.

    The receiver's i-th action holds from physics step `steps[i]` to `steps[i + 1]`, the giver's j-th
    from `giver_steps[j]` until its next; applied at these steps they reproduce the episode bit for bit.

    Attributes:
        observations: Arrays (T + 1, ...) by key of `receiver_observation_space`, at every decision and
            at the end.
        actions: (T, 9) float32 target joint positions, 7 arm joints (rad), 2 fingers (m).
        rewards: (T,) float64, 1 for the decision that completed the handover, else 0.
        terminations: (T,) bool, whether success, contact or a drop ended the episode.
        truncations: (T,) bool, whether the time limit ended the episode.
        steps: (T + 1,) int64 physics steps (1 ms) since the start, at every observation.
        giver_steps: (G,) int64 physics steps of the giver's decisions; empty for the replayed giver.
        giver_actions: (G, 8) float32 deviations from the replay, see `handover_marl.episode.spaces`.
        metadata: Scene, policies and outcome.
    """

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float64]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    steps: npt.NDArray[np.int64]
    giver_steps: npt.NDArray[np.int64]
    giver_actions: npt.NDArray[np.float32]
    metadata: EpisodeMetadata

    def __len__(self) -> int:
        """Return the number of the receiver's decisions."""
        return len(self.actions)
