"""Result of one simulated episode: outcome, times and metrics."""

from dataclasses import dataclass

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.referee import EpisodeStatus


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one simulated scene: outcome, times and metrics.

    Attributes:
        index: Position of the scene in its split; names the official result file.
        status: Outcome flags.
        steps: Physics steps (1 ms) until the end of the episode.
        plan_s: Wall-clock time spent in the receiver's policy (s).
        scene_id: Scene number, or None if unknown (results of HandoverSim's code).
        release_step: Physics step whose contacts made the giver release the object, or None.
        object_name: YCB class of the object handed over, or None if unknown.
        subject: Person recorded in the scene, or None if unknown.
        side: Hand that gives the object, "right" or "left", or None if unknown.
        n_objects: Number of objects on the table, or None if unknown.
        models: Description of the hand model and of other substitutes for HandoverSim's models, or
            None if unknown.
        fingerprint: Hash of the scene's data files, or None if unknown.
        machine: Machine on which `plan_s` was measured, or None if unknown.
        fluency: Metrics beyond the official ones, or None if unknown.
    """

    index: int
    status: EpisodeStatus
    steps: int
    plan_s: float
    scene_id: int | None = None
    release_step: int | None = None
    object_name: str | None = None
    subject: str | None = None
    side: str | None = None
    n_objects: int | None = None
    models: str | None = None
    fingerprint: str | None = None
    machine: str | None = None
    fluency: FluencyMetrics | None = None

    @property
    def success(self) -> bool:
        """Whether the handover was completed."""
        return self.status == EpisodeStatus.SUCCESS

    @property
    def speed_score(self) -> float:
        """Term of the metric average success: 1 - t / 13 s after t s, 0 for a failure."""
        return 1.0 - self.steps / OFFICIAL_CONFIG.protocol.horizon_steps if self.success else 0.0
