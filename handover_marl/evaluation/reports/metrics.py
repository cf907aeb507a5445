"""Official metrics of an evaluation: rates of outcomes, and times."""

from dataclasses import dataclass

import numpy as np

from handover_marl.config import TIME_STEP
from handover_marl.datasets import DATASET_TITLES
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata

FAILURE_STATUSES = (EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)
#: Statuses whose rates are reported.
REPORTED_STATUSES = (EpisodeStatus.SUCCESS, *FAILURE_STATUSES)


@dataclass(frozen=True)
class OfficialMetrics:
    """Official metrics of the evaluated scenes: rates of outcomes, and times.

    Attributes:
        metadata: Identity of the evaluation: policies, scenes, physics and versions.
        episodes: One result per scene, in the split's order.
        n_split_scenes: Number of scenes in the whole split; fewer episodes make the report partial.
        n_resumed: Number of episodes that come from an earlier run in the same folder.
    """

    metadata: ResultMetadata
    episodes: tuple[EpisodeResult, ...]
    n_split_scenes: int
    n_resumed: int = 0

    @property
    def success_rate(self) -> float:
        """Share of episodes with success and no failure (0..1)."""
        return self.compute_rate(EpisodeStatus.SUCCESS)

    @property
    def contact_rate(self) -> float:
        """Share of episodes in which the robot touched the person (0..1)."""
        return self.compute_rate(EpisodeStatus.HUMAN_CONTACT)

    @property
    def drop_rate(self) -> float:
        """Share of episodes in which the object fell (0..1)."""
        return self.compute_rate(EpisodeStatus.OBJECT_DROP)

    @property
    def timeout_rate(self) -> float:
        """Share of episodes that took 13 s without success (0..1)."""
        return self.compute_rate(EpisodeStatus.TIMEOUT)

    @property
    def average_success(self) -> float:
        """Average success (AS): mean of 1 - t / 13 s for successes and 0 for failures (0..1).

        Success and speed in one number, as reported by GenH2R (Wang et al., CVPR 2024); t is the
        simulated time to success.
        """
        return float(np.mean(self.speed_scores))

    @property
    def time_exec(self) -> float | None:
        """Mean simulated time to success (s), over successes; None without successes."""
        return _mean(self.exec_times)

    @property
    def time_plan(self) -> float | None:
        """Mean wall-clock time in the policy (s), over successes; None without successes."""
        return _mean(self.plan_times)

    @property
    def time_total(self) -> float | None:
        """Sum of `time_exec` and `time_plan` (s); None without successes."""
        if self.time_exec is None or self.time_plan is None:
            return None
        return self.time_exec + self.time_plan

    @property
    def is_partial(self) -> bool:
        """Whether only a part of the split's scenes was evaluated."""
        return len(self.episodes) < self.n_split_scenes

    @property
    def exec_times(self) -> list[float]:
        """Simulated time of every success (s)."""
        return [episode.steps * TIME_STEP for episode in self.episodes if episode.success]

    @property
    def plan_times(self) -> list[float]:
        """Wall-clock time in the receiver's policy of every success (s)."""
        return [episode.plan_time_s for episode in self.episodes if episode.success]

    @property
    def speed_scores(self) -> list[float]:
        """Terms of the metric average success, one per scene (0..1)."""
        return [episode.speed_score for episode in self.episodes]

    @property
    def machine_label(self) -> str:
        """Description of the machines on which the receiver's policy was timed."""
        machines = sorted({episode.machine or "an unknown machine" for episode in self.episodes})
        return " and ".join(machines)

    @property
    def data_label(self) -> str:
        """Description of the dataset: name, objects per scene, and substitutes for HandoverSim's models."""
        name = DATASET_TITLES.get(self.metadata.dataset, self.metadata.dataset)
        counts = sorted({episode.n_objects for episode in self.episodes if episode.n_objects is not None})
        models = sorted({episode.models for episode in self.episodes if episode.models})
        return ", ".join(filter(None, (name, _describe_object_count(counts), " or ".join(models))))

    def count(self, status: EpisodeStatus) -> int:
        """Count the episodes with a status flag."""
        return sum(bool(episode.status & status) for episode in self.episodes)

    def compute_rate(self, status: EpisodeStatus) -> float:
        """Compute the share of episodes with a status flag (0..1)."""
        return self.count(status) / len(self.episodes)


def _describe_object_count(counts: list[int]) -> str:
    if not counts:
        return ""
    if counts == [1]:
        return "1 object a scene"
    return f"{counts[0]} to {counts[-1]} objects a scene" if len(counts) > 1 else f"{counts[0]} objects a scene"


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
