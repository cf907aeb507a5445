"""The official metrics of a run, with intervals, as numbers, table and JSON."""

from dataclasses import asdict, dataclass

import numpy as np

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.fluency_tables import fluency_averages
from handover_marl.benchmarking.settings import RunSettings
from handover_marl.benchmarking.statistics import mean_interval, wilson_interval
from handover_marl.config import TIME_STEP
from handover_marl.datasets import DATASET_TITLES
from handover_marl.protocol.status import EpisodeStatus

FAILURES = (EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)


@dataclass(frozen=True)
class Report:
    """Metrics of the scenes that were run. `str(report)` is the official table.

    Attributes:
        settings: What was run on what.
        episodes: One result a scene, in the split's order.
        n_split: Scenes in the whole split; fewer episodes make the report partial.
        n_earlier: How many of the episodes come from an earlier run in the same folder.
    """

    settings: RunSettings
    episodes: tuple[EpisodeResult, ...]
    n_split: int
    n_earlier: int = 0

    @property
    def success_rate(self) -> float:
        """Share of episodes with success alone (0..1)."""
        return self._rate(EpisodeStatus.SUCCESS)

    @property
    def contact_rate(self) -> float:
        """Share of episodes in which the robot touched the person (0..1)."""
        return self._rate(EpisodeStatus.HUMAN_CONTACT)

    @property
    def drop_rate(self) -> float:
        """Share of episodes in which the object fell (0..1)."""
        return self._rate(EpisodeStatus.OBJECT_DROP)

    @property
    def timeout_rate(self) -> float:
        """Share of episodes that took 13 s without success (0..1)."""
        return self._rate(EpisodeStatus.TIMEOUT)

    @property
    def average_success(self) -> float:
        """AS: the mean over all episodes of 1 - t / 13 s for successes, 0 for failures (0..1).

        Success and speed in one number, as GenH2R (Wang et al., CVPR 2024) reports it; t is `time_exec`'s.
        """
        return float(np.mean(self.speed_scores()))

    @property
    def time_exec(self) -> float | None:
        """Mean simulated time to success (s), over successes; None without any."""
        return _mean(self.exec_times())

    @property
    def time_plan(self) -> float | None:
        """Mean wall-clock time in the policy (s), over successes; None without any."""
        return _mean(self.plan_times())

    @property
    def time_total(self) -> float | None:
        """`time_exec` + `time_plan` (s); None without successes."""
        if self.time_exec is None or self.time_plan is None:
            return None
        return self.time_exec + self.time_plan

    @property
    def partial(self) -> bool:
        """Whether scenes of the split are missing."""
        return len(self.episodes) < self.n_split

    def count(self, status: EpisodeStatus) -> int:
        """Episodes with a flag."""
        return sum(bool(episode.status & status) for episode in self.episodes)

    def exec_times(self) -> list[float]:
        """Simulated time of every success (s)."""
        return [episode.steps * TIME_STEP for episode in self.episodes if episode.success]

    def speed_scores(self) -> list[float]:
        """What AS is the mean of, a number a scene."""
        return [episode.speed_score for episode in self.episodes]

    def plan_times(self) -> list[float]:
        """Policy time of every success (s)."""
        return [episode.plan_time for episode in self.episodes if episode.success]

    def machine_label(self) -> str:
        """Where planning was timed."""
        machines = sorted({episode.machine or "an unknown machine" for episode in self.episodes})
        return " and ".join(machines)

    def data_label(self) -> str:
        """The dataset in words: objects in a scene, whose hands, and what else is not HandoverSim's own."""
        name = DATASET_TITLES.get(self.settings.dataset, self.settings.dataset)
        counts = sorted({episode.n_objects for episode in self.episodes if episode.n_objects is not None})
        models = sorted({episode.models for episode in self.episodes if episode.models})
        said = [name, _objects_in_words(counts), *([" or ".join(models)] if models else [])]
        return ", ".join(part for part in said if part)

    def to_json(self) -> dict[str, object]:
        """Everything, ready for `json.dump`; rates 0..1, intervals 95 %, times in s."""
        n = len(self.episodes)
        flags = {
            "success": EpisodeStatus.SUCCESS,
            "contact": FAILURES[0],
            "drop": FAILURES[1],
            "timeout": FAILURES[2],
        }
        return {
            **asdict(self.settings),
            "data": self.data_label(),
            "machine": self.machine_label(),
            "episodes_run": n,
            "episodes_from_an_earlier_run": self.n_earlier,
            "episodes_in_split": self.n_split,
            "rates": {
                name: {"rate": self._rate(flag), "interval_95": wilson_interval(self.count(flag), n)}
                for name, flag in flags.items()
            },
            "average_success": {
                "mean": self.average_success,
                "interval_95": mean_interval(self.speed_scores()),
            },
            "times": {
                "exec": {"mean": self.time_exec, "interval_95": mean_interval(self.exec_times())},
                "plan": {"mean": self.time_plan, "interval_95": mean_interval(self.plan_times())},
                "total": {"mean": self.time_total},
            },
            "fluency": {key: asdict(value) for key, value in fluency_averages(self.episodes).items()},
            "episodes": [
                {**asdict(episode), "status": int(episode.status), "outcome": episode.status.label}
                for episode in self.episodes
            ],
        }

    def __str__(self) -> str:
        from handover_marl.benchmarking.tables import report_text

        return report_text(self)

    def _rate(self, status: EpisodeStatus) -> float:
        return self.count(status) / len(self.episodes)


def _objects_in_words(counts: list[int]) -> str:
    if not counts:
        return ""
    if counts == [1]:
        return "1 object a scene"
    return f"{counts[0]} to {counts[-1]} objects a scene" if len(counts) > 1 else f"{counts[0]} objects a scene"


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
