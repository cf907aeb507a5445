"""What remains of an episode when it is over."""

from dataclasses import dataclass

from handover_marl.config import OFFICIAL
from handover_marl.episode.fluency import Fluency
from handover_marl.protocol.status import EpisodeStatus


@dataclass(frozen=True)
class EpisodeResult:
    """One scene's outcome.

    Attributes:
        index: Position of the scene in its split; names the official result file.
        status: How it ended.
        steps: Physics steps (ms) until then.
        plan_time: Wall-clock time spent in the policy (s).
        scene_id: Number of the scene, or None where a foreign result folder does not tell.
        release_step: The step whose contacts made the person let go, or None.
        object_name: Class of the object handed over, or None if unknown.
        subject: The person who gave it, or None if unknown.
        side: "right" or "left" hand, or None if unknown.
        n_objects: Objects on the table, or None if unknown.
        models: Which hand the scene was played with and what else was not HandoverSim's own, in words, or None if
            unknown.
        fingerprint: Hash of the scene's data files, or None if unknown.
        machine: Where `plan_time` was measured, or None if unknown.
        fluency: Metrics beyond the official ones, or None if unknown.
    """

    index: int
    status: EpisodeStatus
    steps: int
    plan_time: float
    scene_id: int | None = None
    release_step: int | None = None
    object_name: str | None = None
    subject: str | None = None
    side: str | None = None
    n_objects: int | None = None
    models: str | None = None
    fingerprint: str | None = None
    machine: str | None = None
    fluency: Fluency | None = None

    @property
    def success(self) -> bool:
        """Whether the handover was completed."""
        return self.status == EpisodeStatus.SUCCESS

    @property
    def speed_score(self) -> float:
        """1 - t / 13 s for a success that took t, 0 for a failure: what AS is the mean of."""
        return 1.0 - self.steps / OFFICIAL.protocol.horizon_steps if self.success else 0.0
