"""Report of an evaluation: official metrics with confidence intervals, as text and JSON."""

from dataclasses import asdict, dataclass

from handover_marl.evaluation.reports.fluency_tables import compute_fluency_means
from handover_marl.evaluation.reports.metrics import REPORTED_STATUSES, OfficialMetrics
from handover_marl.evaluation.reports.report_tables import format_report
from handover_marl.evaluation.reports.statistics import compute_mean_interval, compute_wilson_interval


@dataclass(frozen=True)
class Report(OfficialMetrics):
    """Report of an evaluation, with all its metrics. `str(report)` is tables in Markdown.

    Attributes:
        metadata: Identity of the evaluation: policies, scenes, physics and versions.
        episodes: One result per scene, in the split's order.
        n_split_scenes: Number of scenes in the whole split; fewer episodes make the report partial.
        n_resumed: Number of episodes that come from an earlier run in the same folder.
    """

    def __str__(self) -> str:
        return format_report(self)

    def to_json(self) -> dict[str, object]:
        """Return metrics and episodes as JSON types; rates 0..1, 95 % intervals, times in s."""
        n = len(self.episodes)
        return {
            **asdict(self.metadata),
            "data": self.data_label,
            "machine": self.machine_label,
            "n_episodes": n,
            "n_resumed": self.n_resumed,
            "n_split_scenes": self.n_split_scenes,
            "rates": {
                flag.label: {
                    "rate": self.compute_rate(flag),
                    "interval_95": compute_wilson_interval(self.count(flag), n),
                }
                for flag in REPORTED_STATUSES
            },
            "average_success": {
                "mean": self.average_success,
                "interval_95": compute_mean_interval(self.speed_scores),
            },
            "times": {
                "exec": {"mean": self.time_exec, "interval_95": compute_mean_interval(self.exec_times)},
                "plan": {"mean": self.time_plan, "interval_95": compute_mean_interval(self.plan_times)},
                "total": {"mean": self.time_total},
            },
            "fluency": {key: asdict(value) for key, value in compute_fluency_means(self.episodes).items()},
            "episodes": [
                {**asdict(episode), "status": int(episode.status), "outcome": episode.status.label}
                for episode in self.episodes
            ],
        }
